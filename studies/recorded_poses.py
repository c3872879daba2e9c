"""Part of the study `recordings`: compares the pose that a fit finds for a recording with the true one, and shows what it
does to the stretch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from diffcloud.errors import ConfigError, EpisodeError
from diffcloud.estimation.result import describe_fit
from diffcloud.estimation.settings import FitSettings
from diffcloud.estimation.task import Recording
from diffcloud.evaluation.markdown import markdown_table, result_page
from diffcloud.evaluation.summary import percent
from diffcloud.io.episodes import Episode, read_episode
from diffcloud.io.raw_episodes import RawEpisode, read_raw_episode
from diffcloud.jobs.fits import FitJob
from diffcloud.jobs.pool import Tell
from diffcloud.jobs.scenarios import scenario_options
from diffcloud.jobs.settings import SynthesizeConfig
from diffcloud.scene.scenarios import GridScenario, Scenario, make_scenario
from diffcloud.scene.scenarios.layout import find_layout
from diffcloud.sensing.calibration.checkerboard import rigid_motion
from diffcloud.sensing.cameras import inverse, transform
from diffcloud.sensing.recorder import Truth, read_truth
from diffcloud.settings import updated

POSE_HEAD = (
    "cloth at the start",
    "alignment",
    "recordings",
    "stretching: median error",
    "greatest",
    "start: median mm off",
    "median ° off",
    "within 3 mm and 1°",
    "lag: median ms",
)
STARTS = ("as the scenario says", "as the scenario says, its turn fitted", "as the first frame shows it")
_TURN = "turn=10deg"
"""As fits with the second of them have it."""


@dataclass(frozen=True)
class PoseJob:
    """Fits of one recording with its mass known, one for each nuisance and start of the cloth."""

    scenario: Scenario
    folder: Path
    """Raw episode with its truth."""
    episode: Path
    nuisance: tuple[str, ...]
    config: FitSettings

    @property
    def label(self) -> str:
        return f"{self.scenario.name}/{self.folder.name}"

    def run(self, tell: Tell) -> list[dict[str, Any]]:
        """Of each fit: error of the stretch's logarithm, RMS distance [mm] and angle [°] between the nodes' starting
        positions and those in the clouds, and the lag found [ms], None where it is not free; with `cameras_off`."""
        episode = read_episode(self.episode)
        raw, truth = read_raw_episode(self.folder), read_truth(self.folder)
        true, preprocessed = recorded_places(raw, truth, episode), cameras_off(truth, episode)
        hidden, found = episode.meta["truth"], []
        every = [(start, nuisance) for start in STARTS for nuisance in self.nuisance]
        for place, (start, nuisance) in enumerate(every):
            tell(place / len(every), f"{start}, {nuisance}")
            scenario = placed(self.scenario, episode) if start == STARTS[2] else self.scenario
            turned = _TURN if start == STARTS[1] else "none"
            known = self.scenario.in_si({"density": hidden["density"]})
            config = updated(self.config, parameters=["stretching"], fixed=known, alignment=nuisance, initial_state=turned)
            job = FitJob(self.label, [Recording(scenario, self.label, episode)], config, self.folder)
            objective, outcome = job.task.solved()
            outcome = outcome.uninterrupted()
            result = describe_fit(objective, job.task.space, job.task.solver_settings, outcome, episodes=[self.label])
            moved = result.motions[0].nodes[0]
            lag = result.record.nuisance.get("lag")
            found.append(
                {
                    "start": start,
                    "nuisance": nuisance,
                    "stretching": abs(math.log(outcome.values["stretching"] / hidden["stretching"])),
                    "shift_mm": 1e3 * float(np.sqrt(((moved - true) ** 2).sum(-1).mean())),
                    "turn_deg": math.degrees(Rotation.from_matrix(rigid_motion(moved, true)[:3, :3]).magnitude()),
                    "lag_ms": None if lag is None else 1e3 * lag.value,
                    **preprocessed,
                }
            )
        return found


def placed(scenario: Scenario, episode: Episode) -> Scenario:
    """A grid scenario whose cloth lies where the recording's first frame shows it, as `diffcloud fit` finds it.

    Raises:
        ConfigError: not a grid scenario.
        EpisodeError: the first frame does not show a flat cloth of the scenario's size.
    """
    options = scenario_options(scenario.name)
    if not isinstance(options, GridScenario):
        raise ConfigError(f"{scenario.name} is not a scenario with a cloth lying on a table.")
    found = find_layout(episode, options.size_m).fields
    center, yaw, table = (found[name].value for name in ("center_m", "yaw_deg", "table_height_m"))
    quarter = 90.0 if math.isclose(*options.size_m) else 180.0  # turns after which the rectangle looks the same
    yaw = float(cast(float, yaw))
    yaw += quarter * round((options.yaw_deg - yaw) / quarter)
    return make_scenario(options.model_copy(update={"center_m": center, "yaw_deg": yaw, "table_height_m": table}))


def recorded_places(raw: RawEpisode, truth: Truth, episode: Episode) -> NDArray[np.float64]:
    """[V, 3] where the clouds have the cloth's nodes at the start, in the scene's frame as the recording states it.

    The mean over the cameras, which are not where preprocessing had them.

    Raises:
        EpisodeError: the episode does not say where preprocessing had its cameras.
    """
    world = truth.nodes[0]
    seen = [transform(off, world) for off in _displacements(truth, episode)]
    return raw.placement.to_scene(np.mean(seen, axis=0))


def cameras_off(truth: Truth, episode: Episode) -> dict[str, float]:
    """How far preprocessing had the worse camera from its place, as the mean shift of its picture of the cloth (camera_mm),
    and the lag that it found for the joint log (log_late_ms)."""
    nodes = truth.nodes.reshape(-1, 3)
    shifts = [transform(off, nodes).mean(axis=0) - nodes.mean(axis=0) for off in _displacements(truth, episode)]
    return {
        "camera_mm": 1e3 * max(float(np.linalg.norm(shift)) for shift in shifts),
        "log_late_ms": 1e3 * episode.meta["quality"]["refinement"]["clock_offset_s"],
    }


def _displacements(truth: Truth, episode: Episode) -> list[NDArray[np.float64]]:
    """[4, 4] of each camera, from where something is to where the clouds have it, since preprocessing had it elsewhere."""
    refined = episode.meta.get("quality", {}).get("refinement", {}).get("T_world_camera")
    if refined is None:
        raise EpisodeError(
            "The episode does not give the refined camera poses: preprocess it with `preprocess.raw.refine: true`."
        )
    return [np.array(refined[name]) @ inverse(pose) for name, pose in truth.T_world_camera.items()]


def pose_rows(found: Sequence[Sequence[dict[str, Any]]]) -> list[list[str]]:
    """Under `POSE_HEAD`, a row for each nuisance."""
    rows = []
    for fits in zip(*found, strict=True):
        off, shift, turn = (np.array([fit[key] for fit in fits]) for key in ("stretching", "shift_mm", "turn_deg"))
        lags = [abs(fit["lag_ms"]) for fit in fits if fit["lag_ms"] is not None]
        right = int(((shift <= 3) & (turn <= 1)).sum())
        rows.append(
            [
                fits[0]["start"],
                fits[0]["nuisance"],
                str(len(fits)),
                f"{100 * math.expm1(float(np.median(off))):.1f} %",
                percent(math.expm1(float(off.max()))),
                f"{np.median(shift):.1f}",
                f"{np.median(turn):.2f}",
                f"{right} of {len(fits)}",
                f"{np.median(lags):.1f}" if lags else "–",
            ]
        )
    return rows


def pose_page(rows: Sequence[Sequence[str]], recordings: Sequence[dict[str, Any]], recorded: SynthesizeConfig) -> str:
    """Markdown: what was recorded, what preprocessing found (`cameras_off` of each recording), and the table."""
    shifts = [one["camera_mm"] for one in recordings]
    late = [abs(one["log_late_ms"] - 1e3 * recorded.clock_offset_s) for one in recordings]
    (together, turned), (apart, twisted), (beside, yaw) = (
        recorded.rig_error,
        recorded.extrinsic_error,
        recorded.placement_error,
    )
    first = rows[0]
    best = [row for row in rows if row[0] == STARTS[1]][-1]
    return result_page(
        f"Do fits hold when cameras moved {'together' if together else 'apart'} and the cloth lies beside its place?",
        f"With turn and alignment fitted, stretching is {best[3]} off in the median and {best[4]} at most, and the start "
        f"is within 3 mm and 1° in {best[7]} recordings. With neither, stretching is {first[3]} off in the median.",
        markdown_table(POSE_HEAD, rows),
        note=f"The cameras' stated places are off by {together:g} mm and {turned:g}° together, the second camera's by "
        f"{apart:g} mm and {twisted:g}° more. Cloth and gripper are shifted by {beside:g} mm and turned by {yaw:g}°. The "
        f"joint log is {1e3 * recorded.clock_offset_s:g} ms late. `diffcloud data preprocess` refines cameras and clock: "
        f"the worse camera ends {np.median(shifts):.1f} mm from its place in the median and {max(shifts):.1f} mm at "
        f"most, the log within {np.median(late):.1f} ms and {max(late):.1f} ms. Then stretching is fitted with known "
        "density.\n\nThe page compares three initial states: that of the scene (`--initial-state none`), the same with a "
        f"fitted rotation of the cloth (`--initial-state {_TURN}`, the default), and that of the first frame. *Start*: RMS "
        "distance and angle between the fitted starting positions of the nodes and the true ones as seen in the clouds.",
        command="make moved",
    )
