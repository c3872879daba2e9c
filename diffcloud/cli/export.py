"""`diffcloud export`: a fitted cloth for another simulator."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import numpy as np
import typer
from rich.table import Table

from diffcloud.cli.options import JsonFlag
from diffcloud.console import errors, finish, progress_bar, show, warn, writes
from diffcloud.errors import ConfigError
from diffcloud.io.files import together
from diffcloud.io.manifests import remove_files
from diffcloud.simulators.export.targets import TARGETS

if TYPE_CHECKING:
    from diffcloud.estimation.record import FitRecord
    from diffcloud.simulators.export.check import Checked, Runnable

TargetName = Literal[*TARGETS]  # type: ignore[valid-type]
_SHOWN = (0.5, 1.0, 1.5, 2.0, 3.0)
"""[s] At which distances are shown."""


@writes()
def export(
    fit: Annotated[Path, typer.Argument(help="JSON of a fit, with its NPZ beside it.")],
    to: Annotated[TargetName, typer.Option("--to", help="Simulator, or file format.")],
    out: Annotated[Path, typer.Option(help="Folder for the model, its motion, and cloth.json, which explains them.")],
    recording: Annotated[
        str | None, typer.Option(help="For a joint fit: the recording whose motion is exported. Default: the first.")
    ] = None,
    samples: Annotated[
        int,
        typer.Option(
            min=0,
            max=10_000,
            help="Further exports, with parameters drawn from the fit's uncertainty, for domain randomisation.",
        ),
    ] = 0,
    seed: Annotated[int, typer.Option(min=0, help="Random seed of --samples.")] = 0,
    check: Annotated[
        bool,
        typer.Option("--check", help="Run the export where its simulator is installed, and compare: mujoco and newton."),
    ] = False,
    json: JsonFlag = False,
) -> None:
    """Write a fitted cloth for another simulator: mesh, material in SI units, and the recorded motion of what is held."""
    from diffcloud.estimation.record import read_fit
    from diffcloud.estimation.result import read_motion
    from diffcloud.jobs.scenarios import choose_scenario, fitted_scenario
    from diffcloud.simulators.export.cloth import fitted_cloth
    from diffcloud.simulators.export.write import described, exported_files, write_export, write_samples

    if check and not TARGETS[to].runs:
        runnable = " and ".join(name for name, one in TARGETS.items() if one.runs)
        raise ConfigError(f"--check runs {runnable}; {to} cannot be run here.")
    if check and importlib.util.find_spec(to) is None:
        raise ConfigError(f"--check needs {to}. Try: pip install 'diffcloud[simulators]', or leave --check out.")
    record = read_fit(fit)
    index = _index(record, recording)
    one = record.episodes[index]
    drawn = _draws(record, fit.parent / "intervals.json", samples, seed) if samples else []
    chosen = choose_scenario(fitted_scenario(fit, one.scenario))
    motion = read_motion(fit.with_suffix(".npz"), index)
    cloth = fitted_cloth(one, motion, chosen, record.values)
    former, about = exported_files(out), {"fit": fit.name}
    with together():
        names, left_out = write_export(cloth, to, out, {**about, **described(one, chosen, record.values)})
        written = {*names, *write_samples(one, motion, chosen, drawn, to, out, about)}
    remove_files(out, sorted(former - written))
    for sentence in left_out:
        warn(sentence)
    if TARGETS[to].simplified:
        lack = 1e3 * cloth.simplified_m
        told_lack = f"moves the cloth by {lack.mean():.1f} mm on average (RMS over nodes), by {lack.max():.1f} mm at worst"
        if not np.isfinite(lack).all():
            told_lack = "cannot be told: the simplified cloth could not be simulated"
        errors.print(f"Simulated by diffcloud, what the export leaves out {told_lack}.", soft_wrap=True)
    several = f", and {samples} more in {out / 'sample_0000'} and so on" if samples else ""
    errors.print(f"Wrote {', '.join(names)} to {out}{several}.", soft_wrap=True)
    told: dict[str, Any] = {"out": str(out), "files": names, "left_out": left_out}
    if TARGETS[to].simplified:
        told["simplified_rms_mm"] = _plain(1e3 * cloth.simplified_m)
    if drawn:
        told["samples"] = [chosen.in_si(each) for each in drawn]
    if check:
        from diffcloud.simulators.export.check import check_export

        with progress_bar("checking", 4) as update:
            steps = iter(range(4))
            found = check_export(cloth, cast("Runnable", to), out, lambda what: update(next(steps), what))
        _show(found, to, json)
        told |= _numbers(found)
    finish(told, json)


def _draws(record: FitRecord, path: Path, count: int, seed: int) -> list[dict[str, float]]:
    """Return parameter sets drawn from the intervals of a fit, as multipliers of all its parameters."""
    from diffcloud.evaluation.intervals import draws, read_intervals
    from diffcloud.evaluation.methods import space_of

    space = space_of(record).asked
    return [{**record.values, **values} for values in draws(read_intervals(path, space), space, count, seed)]


def _index(record: FitRecord, name: str | None) -> int:
    names = [one.name for one in record.episodes]
    if name is None:
        if len(names) > 1:
            errors.print(f"The motion is that of {names[0]}, the first of {len(names)} recordings.")
        return 0
    return record.place_of(name, None)


def _show(found: Checked, target: str, json: bool) -> None:
    table = Table("known answer", "theory", "diffcloud", target, "error")
    for answer in found.answers:
        numbers = (answer.theory, answer.ours, answer.theirs)
        table.add_row(f"{answer.test}: {answer.measure}", *(f"{number:.4g}" for number in numbers), f"{answer.error:+.1%}")
    show(table, json)
    times = [time for time in _SHOWN if time <= found.times[-1] + 1e-9] or [float(found.times[-1])]
    rows = [int(np.abs(found.times - time).argmin()) for time in times]
    table = Table("RMS over nodes from the fitted motion, mm", *(f"{found.times[row]:.2g} s" for row in rows), "largest")
    for name, apart in (
        (f"{target}, as exported", found.apart_mm),
        ("diffcloud, with what was exported", found.simplified_mm),
    ):
        table.add_row(name, *(f"{apart[row]:.1f}" for row in rows), f"{np.max(apart):.1f}")
    show(table, json)


def _numbers(found: Checked) -> dict[str, Any]:
    return {
        "strip_error": found.largest("strip"),
        "cantilever_error": found.largest("cantilever"),
        "times_s": found.times.tolist(),
        "rms_mm": _plain(found.apart_mm),
    }


def _plain(numbers: Any) -> list[float | None]:
    return [float(number) if np.isfinite(number) else None for number in numbers]
