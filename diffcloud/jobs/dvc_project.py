"""Turn the output folder of `diffcloud fit` into a DVC project."""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path

from diffcloud.console import errors
from diffcloud.errors import ConfigError
from diffcloud.estimation.likelihood.settings import LikelihoodSettings
from diffcloud.estimation.record import FitRecord, read_fit
from diffcloud.estimation.settings import LEVEL
from diffcloud.evaluation.intervals import read_intervals
from diffcloud.evaluation.methods import space_of
from diffcloud.io.files import files_in, together, write_text
from diffcloud.io.timings import NAME

_PARAMS = """\
# Settings for the stages of dvc.yaml. A stage runs again when its section or a file that it reads has changed.
fit:
  options: {options}  # all of `diffcloud fit --help` but --out
export:
  to: mujoco  # newton, isaac, arcsim or obj
"""
_DVC = """\
# episodes/ -> fit.json, intervals.json, report.html -> exported/
# A new recording of the cloth is one more file in episodes/.
stages:
  fit:
    cmd: diffcloud fit ${fit.options} --out . episodes/*.npz
    params: [fit]
    deps: [episodes, cloth.yaml, recordings.yaml]
    metrics:
      - intervals.json:
          cache: false
    outs:
      - report.html
      - scenes:
          persist: true
      - fit.json:
          persist: true
      - fit.npz:
          persist: true
      - stages:
          persist: true  # finished fits; the command checks which still belong to these recordings

  export:
    cmd: diffcloud export fit.json --to ${export.to} --out exported
    params: [export]
    deps: [fit.json, fit.npz, scenes]
    outs: [exported]
"""


def make_project(folder: Path) -> None:
    """Write dvc.yaml and params.yaml beside the files of a fit, which remain unchanged.

    Raises:
        ConfigError: the folder already is a project, its fit is not finished, or DVC fails.
    """
    record = _identified(folder)
    pages = {"params.yaml": _PARAMS.format(options=_options(folder, record)), "dvc.yaml": _DVC}
    for name, text in pages.items():
        path = folder / name
        if path.exists() and path.read_text(encoding="utf-8") != text:
            raise ConfigError(f"{path} is there already: this folder is a project. Remove it to have it written anew.")
    if _above(folder, ".dvc") is None:
        _start_dvc(folder)
    ignored = folder / ".dvcignore"
    before = ignored.read_text(encoding="utf-8") if ignored.is_file() else ""
    pattern = NAME.format("*")
    pages |= {} if pattern in before else {".dvcignore": f"{before}{pattern}\n"}
    with together():
        for name, text in pages.items():
            write_text(folder / name, text)
    errors.print(f"Wrote {folder / 'dvc.yaml'}, {folder / 'params.yaml'}. Next: cd {shlex.quote(str(folder))} && dvc repro")


def _above(folder: Path, name: str) -> Path | None:
    """Return the folder or its nearest parent that contains an entry `name`, or None."""
    return next((one for one in (folder.resolve(), *folder.resolve().parents) if (one / name).exists()), None)


def _start_dvc(folder: Path) -> None:
    """Run `dvc init` in a folder.

    Raises:
        ConfigError: DVC failed, or is not installed.
    """
    git = _above(folder, ".git")
    kind = ["--no-scm"] if git is None else [] if git == folder.resolve() else ["--subdir"]
    done = subprocess.run(
        [sys.executable, "-m", "dvc", "init", "--quiet", *kind], cwd=folder, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise ConfigError(f"`dvc init` failed in {folder}: {' '.join((done.stderr or done.stdout).split())[-300:]}")


def _identified(folder: Path) -> FitRecord:
    """Read the finished fit in a folder.

    Raises:
        ConfigError: the fit is not finished, or a recording is missing.
    """
    needed = ["cloth.yaml", "recordings.yaml", "fit.json", "fit.npz", "intervals.json", "report.html"]
    if missing := [name for name in needed if not (folder / name).is_file()]:
        raise ConfigError(
            f"{folder} lacks {', '.join(missing)}, which `diffcloud fit` writes. Run "
            f"`diffcloud fit RECORDING --out {shlex.quote(str(folder))}` first."
        )
    record = read_fit(folder / "fit.json")
    there = {path.stem for path in files_in(folder / "episodes", ".npz")}
    if gone := [one.name for one in record.episodes if one.name not in there]:
        raise ConfigError(
            f"{folder / 'episodes'} lacks {', '.join(gone)}, recordings of the fit; run `diffcloud fit` again."
        )
    return record


def _options(folder: Path, record: FitRecord) -> str:
    """Return the options for `diffcloud fit` that reproduce the fit."""
    options = ["--parameters", ",".join(record.fitted)]
    if (weighed := record.parameters.get("density")) is not None and weighed.fixed:
        options += ["--density", f"{weighed.value:.12g}"]
    told = read_intervals(folder / "intervals.json", space_of(record).asked)
    if told.level != LEVEL:
        options += ["--level", f"{told.level:g}"]
    usual = LikelihoodSettings()
    for name, value in (("starts", usual.starts), ("max_steps", usual.max_steps)):
        if record.settings.get(name, value) != value:
            options += [f"--{name.replace('_', '-')}", str(record.settings[name])]
    return shlex.join(options)
