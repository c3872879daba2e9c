"""How close do default fits come to the published recordings, and do repeats of one fabric agree?

    python -m studies recorded EPISODES [--fits build/recorded]

EPISODES is what `diffcloud data import --kind release --trajectories` writes. Finished fits are kept.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import groupby
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from diffcloud.errors import ConfigError, DiffCloudError
from diffcloud.estimation.record import FitRecord
from diffcloud.estimation.settings import FitSettings
from diffcloud.estimation.task import Recording
from diffcloud.evaluation.markdown import markdown_table, result_page
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
    pairs = _repeats(found)
    rows = []
    for scenario in SCENARIOS:
        fits = [one for one in found.values() if one.scenario == scenario]
        own = [factor for name, factor in pairs if found[name].scenario == scenario]
        agree = f"{sum(factor <= _AGREE for factor in own)} of {len(own)}"
        rows.append([scenario, str(len(fits)), f"{np.mean([one.rms_mm for one in fits]) if fits else math.nan:.1f}", agree])
    head = ["recording", "RMS mm", "to recording, to cloth", "frames", "stretching / density", "bending", "compression"]
    head += ["shear", "shift cm", "yaw", "s"]
    return result_page(
        "How close do default fits come to the published recordings?",
        f"The mean RMS distance is {' and '.join(f'{row[2]} mm ({row[0]})' for row in rows)}. Repeats of a fabric agree on "
        f"stretching over density within a factor of {_AGREE} in {sum(factor <= _AGREE for _, factor in pairs)} of "
        f"{len(pairs)} pairs.",
        markdown_table(["scene", "recordings", "mean RMS mm", f"pairs within a factor of {_AGREE}"], rows),
        note="Two lifts and two folds of each of five fabrics are fitted in metres, under the recorded path of the gripper "
        "([scenes](../scenarios.md#the-published-recordings)). RMS is over both directions and the frames up to the "
        "[horizon](../solver.md#likelihood) of the fit. Each distance is capped at 5 cm ([the "
        "loss](../concepts.md#the-loss)). Frames count from 5 % of the cloth above the crop height on. "
        "The residual is several times the noise, so each fit uses its five earliest frames and has the status "
        "`model_error`. Some values end at bounds. So the values reproduce these motions and are no properties of the "
        "fabrics.",
        command="python -m studies recorded EPISODES",
        details={
            "The early frames": [
                "Six recordings were looked at. Their early clouds contain the fingers of the gripper and stray points, "
                "and the surfaces of the two cameras lie centimetres apart. Up to 2026-11-30, frames counted from 50 % of "
                "the cloth above the crop height on, or 80 % of the largest part. These are later and cleaner frames: the "
                "mean RMS distance was 9.2 mm (lifts) and 10.2 mm (folds), and five of ten pairs agreed. Recordings from "
                "MuJoCo without such points need the early frames ([foreign.md](foreign.md)).",
            ],
            "Each recording": [
                "Stretching over density is in (N/m)/(kg/m²), bending in µN·m. Compression is the part of the stretching "
                "stiffness that resists compression. Shear is a factor on the scene's value. A star marks a value at a "
                "bound of the search. Shift and yaw are those of the scene.",
                markdown_table(head, [_row(name, one) for name, one in found.items()]),
            ],
            "Repeats": [
                "Larger by smaller stretching over density of two recordings, such as `fold_navy` and `fold_navy2`.",
                markdown_table(["pair", "factor"], [[name, f"{factor:.2f}"] for name, factor in pairs]),
            ],
        },
    )


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


def _repeats(found: Mapping[str, FitRecord]) -> list[tuple[str, float]]:
    """Name of the first recording of each pair, and the pair's factor."""
    pairs = []
    for fabric, names in groupby(sorted(found), key=lambda name: name.removesuffix("2")):
        values = [_ratio(found[name]) for name in names]
        if len(values) == 2:
            pairs.append((fabric, max(values) / min(values)))
    return pairs


if __name__ == "__main__":
    app()
