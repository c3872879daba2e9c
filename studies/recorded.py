"""How close do default fits come to the published recordings, and do repeats of one fabric agree?

    python -m studies recorded EPISODES [--fits build/recorded]

EPISODES is what `diffcloud data import --kind release --trajectories` writes. Finished fits are kept.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from diffcloud.errors import ConfigError, DiffCloudError
from diffcloud.estimation.record import FitRecord
from diffcloud.estimation.settings import FitSettings
from diffcloud.estimation.task import Recording
from diffcloud.evaluation.markdown import markdown_table
from diffcloud.io.episodes import read_episode
from diffcloud.io.files import write_text
from diffcloud.jobs.fits import FitJob
from diffcloud.jobs.pool import run_all
from diffcloud.scene.scenarios import load_scenario

SCENARIOS = ("recorded_lift", "recorded_fold")
PAGE = Path("docs/results/recorded.md")
_AGREE = 1.5
"""Factor within which two repeats count as equal."""

app = typer.Typer(pretty_exceptions_enable=False)


@app.command()
def main(
    episodes: Annotated[Path, typer.Argument(help="Folder that holds recorded_lift and recorded_fold.")],
    fits: Annotated[Path, typer.Option(help="Folder for the fits.")] = Path("build/recorded"),
    markdown: Annotated[Path, typer.Option(help="Page of results.")] = PAGE,
    workers: Annotated[int, typer.Option(min=1, help="Fits at once.")] = 2,
) -> None:
    """Fit the published recordings with default settings, and write the page."""
    found: dict[str, FitRecord] = {}
    for scenario in SCENARIOS:
        files = sorted((episodes / scenario).glob("*.npz"))
        if not files:
            raise ConfigError(
                f"{episodes / scenario} holds no episodes: `diffcloud data import --trajectories` writes them."
            )
        jobs = [
            FitJob(
                file.stem,
                [Recording(load_scenario(scenario), file.stem, read_episode(file))],
                FitSettings(),
                fits / scenario,
            )
            for file in files
        ]
        for job, record, error in run_all("fit", jobs, workers, patient=True):
            if record is None:
                raise DiffCloudError(f"{job.label}: {error}")
            found[job.name] = record
    write_text(markdown, page(found))


def page(found: Mapping[str, FitRecord]) -> str:
    """
    Args:
        found: name of a recording -> its fit.
    """
    lifts, folds = ([one for one in found.values() if one.scenario == scenario] for scenario in SCENARIOS)
    agreed, pairs = _repeats(found)
    head = ["recording", "RMS, mm", "to recording, to cloth", "frames", "stretching / density", "bending", "compression"]
    head += ["shear", "shift, cm", "yaw", "s"]
    return "\n".join(
        [
            "# The published recordings, as recordings",
            "",
            "Default fits of the 20 real recordings that were published with the paper: two lifts and two folds of each of "
            "five fabrics, in metres, under the recorded path of the gripper (scenarios "
            "[`recorded_lift` and `recorded_fold`](../scenarios.md#the-published-recordings)). The import corrects one "
            "camera against the other ([published-data.md](../published-data.md)). RMS is over both directions and the "
            "frames up to the fit's [horizon](../solver.md#likelihood). Frames with little of the cloth above the height "
            "where the clouds were cut off do not count. Each distance is capped at 5 cm "
            "([the loss](../concepts.md#the-loss)).",
            "",
            f"Mean RMS: {_mean(lifts):.1f} mm (lifts), {_mean(folds):.1f} mm (folds).",
            "",
            *markdown_table(head, [_row(name, one) for name, one in found.items()]),
            "",
            "Stretching over density is in (N/m)/(kg/m²), bending in µN·m. Compression is the part of the stretching "
            "stiffness that resists compression, shear the factor on the scenario's. Values at a bound of the search have "
            "a star. Shift and yaw say how far the fit moves the scene.",
            "",
            "## Repeats",
            "",
            f"In {agreed} of {len(pairs)} pairs of repeats, such as `fold_navy` and `fold_navy2`, stretching over density "
            f"agrees within a factor of {_AGREE}:",
            "",
            *markdown_table(["pair", "factor"], [[name, f"{factor:.2f}"] for name, factor in pairs]),
            "",
            "The residual is several times the noise of the points, and several values end at bounds. So the values "
            "reproduce these motions, and are no properties of the fabrics: such cloth hardly stretches when it is lifted "
            "or folded.",
            "",
            "`python -m studies recorded EPISODES` makes this page.",
            "",
        ]
    )


def _mean(fits: Sequence[FitRecord]) -> float:
    return float(np.mean([one.rms_mm for one in fits])) if fits else math.nan


def _row(name: str, fit: FitRecord) -> list[str]:
    (one,) = fit.episodes
    moved = {key: entry.value for key, entry in one.nuisance.items()}

    def told(parameter: str, digits: int, times: float = 1.0) -> str:
        entry = fit.parameters[parameter]
        return f"{times * entry.multiplier:.{digits}g}" + ("*" if entry.at_bound else "")

    bound = any(fit.parameters[parameter].at_bound for parameter in ("stretching", "density"))
    return [
        name,
        f"{fit.rms_mm:.1f}",
        f"{one.rms_to_recording_mm:.1f}, {one.rms_to_cloth_mm:.1f}",
        str(len(one.frames)),
        f"{_ratio(fit):.3g}" + ("*" if bound else ""),
        f"{1e6 * fit.parameters['bending'].value:.3g}",
        told("compression", 2),
        told("shear", 2),
        f"{100 * math.hypot(moved.get('x', 0.0), moved.get('y', 0.0)):.1f}",
        f"{math.degrees(moved.get('yaw', 0.0)):.1f}°",
        "" if fit.seconds is None else f"{fit.seconds:.0f}",
    ]


def _ratio(fit: FitRecord) -> float:
    """[(N/m)/(kg/m²)]"""
    return fit.parameters["stretching"].value / fit.parameters["density"].value


def _repeats(found: Mapping[str, FitRecord]) -> tuple[int, list[tuple[str, float]]]:
    """How many pairs agree, and each pair's factor."""
    pairs = []
    for fabric, names in groupby(sorted(found), key=lambda name: name.removesuffix("2")):
        values = [_ratio(found[name]) for name in names]
        if len(values) == 2:
            pairs.append((fabric, max(values) / min(values)))
    return sum(factor <= _AGREE for _, factor in pairs), pairs


if __name__ == "__main__":
    app()
