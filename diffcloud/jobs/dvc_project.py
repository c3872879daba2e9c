"""Turn the output folder of `diffcloud fit` into a DVC project."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from diffcloud.console import errors
from diffcloud.errors import ConfigError
from diffcloud.estimation.record import read_fit
from diffcloud.io.files import files_in, together, write_text
from diffcloud.io.timings import NAME
from diffcloud.jobs.scene_files import MESH

_PARAMS = """\
# Settings for the stages of dvc.yaml. A stage runs again when its section or a file that it reads has changed.
fit:
  options: {options}  # see `diffcloud fit --help`
export:
  to: mujoco  # newton, isaac, arcsim or obj
"""
_DVC = """\
# episodes/ -> fit.json, intervals.json, report.html -> exported/
# A new recording of the cloth is one more file in episodes/.
stages:
  fit:
    cmd: diffcloud fit ${{fit.options}} --out . episodes/*.npz
    params: [fit]
    deps: [episodes, cloth.yaml, recordings.yaml{more}]
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
    cmd: diffcloud export fit.json --to ${{export.to}} --out exported
    params: [export]
    deps: [fit.json, fit.npz, scenes]
    outs: [exported]
"""


def make_project(folder: Path, options: Sequence[str], params: Path | None = None) -> None:
    """Write dvc.yaml and params.yaml beside the files of a fit, which remain unchanged.

    Args:
        options: options of `diffcloud fit`.
        params: file of `--params`.

    Raises:
        ConfigError: the folder already is a project, its fit is not finished, or DVC fails.
    """
    _check_finished(folder)
    words, more = list(options), [MESH] if (folder / MESH).is_file() else []
    if params is not None:
        file = os.path.relpath(params, folder)
        words, more = [*words, "--params", file], [*more, file]
    pages = {
        "params.yaml": _PARAMS.format(options=json.dumps(shlex.join(words))),
        "dvc.yaml": _DVC.format(more="".join(f", {json.dumps(file)}" for file in more)),
    }
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


def _check_finished(folder: Path) -> None:
    """Check that a folder has a finished fit and its recordings.

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
