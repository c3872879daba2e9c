"""Python interface (`import diffcloud as dc`): from recordings to a fitted cloth, in SI units.

The command line does the same with files: `diffcloud fit` runs the same fit with the same settings as `fit`.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
import yaml
from torch import Tensor

from diffcloud.clouds.losses import one_sided_chamfer
from diffcloud.clouds.neighbours import NeighbourIndex
from diffcloud.clouds.sampling import SurfaceSampler
from diffcloud.errors import ConfigError, EpisodeError, unknown_name
from diffcloud.estimation.record import FitRecord
from diffcloud.estimation.result import FitResult, FittedMotion, write_fit
from diffcloud.estimation.settings import FitSettings
from diffcloud.estimation.solvers import Progress
from diffcloud.estimation.task import FitTask, Recording, compared
from diffcloud.evaluation.intervals import Intervals, draws, intervals_of, stated_parameters, worded
from diffcloud.evaluation.methods import space_of
from diffcloud.identification import (
    fit_settings,
    found_cloth,
    found_layout,
    known_grip,
    prepared,
    starts_hanging,
    with_density,
)
from diffcloud.io.episodes import Episode, read_episode
from diffcloud.io.files import read_yaml, together, write_json, write_text
from diffcloud.io.grippers import tracks_beside
from diffcloud.io.imports import cloud_folder
from diffcloud.reporting.fit_page import Status, Told, page_of, summary_of
from diffcloud.scene.scenarios import Scenario, load_scenario
from diffcloud.scene.scenarios.catalogue import make_scenario, own_options, with_paths
from diffcloud.sim.properties import PARAMETERS
from diffcloud.sim.simulate import Rollout, rollout
from diffcloud.simulators.export.cloth import fitted_cloth
from diffcloud.simulators.export.write import described, write_export, write_samples


@dataclass(frozen=True)
class Estimate:
    """Estimate of one quantity."""

    value: float
    unit: str
    interval: tuple[float, float] | None
    """(low, high). None if the solver does not estimate uncertainty."""
    level: float
    """Probability that the interval contains the value."""
    status: str
    """`identified`, or why it is not. Empty without an interval."""
    deviations: Mapping[str, float] = field(default_factory=dict)
    """Source of uncertainty -> standard deviation of the logarithm, largest first. If the lower bound of the quantity
    is zero, standard deviations are fractions of its range instead."""

    def __str__(self) -> str:
        ends = "" if self.interval is None else f" ({self.interval[0]:.3g} to {self.interval[1]:.3g})"
        ends += f", {worded(self.status)}" if self.status else ""
        return f"{self.value:.3g} {self.unit}{ends}"


@dataclass(frozen=True)
class Scene:
    """A cloth, the motion of its handles, and its surroundings."""

    name: str
    options: Mapping[str, Any]
    """Fields of a YAML scenario (docs/scenarios.md)."""
    settings: FitSettings = field(default_factory=FitSettings)
    """Default settings of a fit in this scene."""

    @staticmethod
    def load(source: str | Path) -> Scene:
        """Load a built-in scenario by its name, or a YAML file.

        Raises:
            ConfigError, SceneError: the scenario is unknown, or its file is invalid.
        """
        if not str(source).endswith((".yaml", ".yml")):
            load_scenario(source)  # only to check the name
            return Scene(str(source), {"base": str(source)})
        path = Path(source)
        load_scenario(path)  # only to check the file
        return Scene(path.stem, with_paths(read_yaml(path, error=ConfigError) or {}, path.parent))

    @cached_property
    def scenario(self) -> Scenario:
        """The scenario for the simulator and fits."""
        if set(self.options) == {"base"}:
            return load_scenario(str(self.options["base"]))
        return make_scenario(own_options(self.options, self.name, f"scene {self.name}", folder=Path()))

    def simulate(self, quantities: Mapping[str, float | Tensor] | None = None, seconds: float | None = None) -> Rollout:
        """Simulate the scene, optionally with other material parameters.

        Args:
            quantities: parameter values in SI units, such as {"stretching": 40.0}. Numbers, or tensors of shape [] or
                [B], in which the motion is differentiable. Names are those of `Fit.parameters`.
            seconds: duration. Default: the scene's whole motion.

        Returns:
            `positions` and `velocities` [B, S + 1, V, 3] in float64, [m] and [m/s], at `times` [S + 1] [s].

        Raises:
            ConfigError: a quantity is unknown, or batch sizes differ.
            DivergedError: the simulation diverged. The message has the step and batch entries.
        """
        scenario = self.scenario
        system, _ = scenario.scene.build()
        values = dict[str, Tensor]()
        for name, value in (quantities or {}).items():
            if name not in PARAMETERS:
                raise ConfigError(unknown_name("quantity", name, PARAMETERS))
            values[name] = torch.as_tensor(value, dtype=torch.float64).reshape(-1) / scenario.nominal(name)
        count = max((len(value) for value in values.values()), default=1)
        values = {name: value.expand(count) if len(value) == 1 else value for name, value in values.items()}
        steps = scenario.steps if seconds is None else max(round(seconds / scenario.scene.time_step), 1)
        return rollout(system, steps, properties=scenario.properties(system, values))


@dataclass(frozen=True)
class Fit:
    """Result of a fit to one or several recordings of a cloth."""

    parameters: Mapping[str, Estimate]
    """Quantity -> estimate, in SI units."""
    status: str
    """`fits_to_noise`, `model_error`, `not_converged`, `interrupted`, or `no_uncertainty` (not estimated by the
    solver)."""
    residual: float
    """RMS distance between simulated and recorded points [m]."""
    horizons: Mapping[str, float]
    """Recording -> time of the last used frame [s]. Empty if the solver has no horizon."""
    scenes: Sequence[Scene]
    """Scenes with the estimated grasp."""
    record: FitRecord
    """The complete result, as in `fit.json`."""
    intervals: Intervals | None
    motions: Sequence[FittedMotion]
    """Motion of each recording with the fitted values."""

    def __str__(self) -> str:
        lines = [f"{worded(self.status)}, residual {1e3 * self.residual:.1f} mm"]
        return "\n".join([*lines, *(f"{name}: {told}" for name, told in self.parameters.items())])

    def _repr_html_(self) -> str:
        """Return an HTML table of the parameters, for notebooks."""
        rows = [
            {
                "parameter": name,
                "value": f"{one.value:.3g} {one.unit}",
                "interval": "" if one.interval is None else f"{one.interval[0]:.3g} to {one.interval[1]:.3g}",
                "status": worded(one.status),
            }
            for name, one in self.parameters.items()
        ]
        head = f"<p>{worded(self.status)}, residual {1e3 * self.residual:.1f} mm</p>"
        return head + str(pd.DataFrame(rows).to_html(index=False))

    def sample(self, count: int, seed: int = 0) -> pd.DataFrame:
        """Sample parameter sets from the posterior: one row per set, one column per quantity in SI units.

        Raises:
            ConfigError: there are no intervals, or the fit has a model error.
        """
        if self.intervals is None:
            raise ConfigError("Only a fit by the solver likelihood knows how uncertain it is; fit again with it.")
        drawn = pd.DataFrame(draws(self.intervals, space_of(self.record).asked, count, seed))
        return drawn * {name: entry.nominal for name, entry in self.intervals.parameters.items()}

    def save(self, folder: str | Path) -> Path:
        """Write fit.json, fit.npz, intervals.json and scenes/ for `diffcloud export`, `view` and `simulate`.

        Returns:
            The path of fit.json.
        """
        folder = Path(folder)
        with together():
            path = write_fit(folder, "fit", FitResult(self.record, list(self.motions)))
            for scene in self.scenes:
                text = yaml.safe_dump(dict(scene.options), sort_keys=False)
                write_text(folder / "scenes" / f"{scene.name}.yaml", text)
            if self.intervals is not None:
                write_json(folder / "intervals.json", self.intervals.model_dump(mode="json"))
        return path


def load_recording(
    path: str | Path, *, grippers: Mapping[str, str | Path] | None = None, rate_hz: float | None = None
) -> Episode:
    """Load a recording from an episode file, or from a folder of numbered clouds.

    Args:
        path: `.npz` file, or folder of `.npy`, `.ply`, `.xyz` or `.pcd` files in metres, z up.
        grippers: for a folder: gripper name -> CSV file with columns t_s, x, y, z. Default: its gripper.csv, or
            its gripper_NAME.csv for each of several.
        rate_hz: for a folder: frame rate, if neither the CSV nor the file names have times.

    Raises:
        EpisodeError: the recording is missing or damaged. The message explains how to import other recordings.
    """
    path = Path(path)
    if path.is_file():
        return read_episode(path)
    if not path.is_dir():
        raise EpisodeError(f"No such recording: {path}.")
    if grippers is None:
        grippers = tracks_beside(path)
    return cloud_folder(path, grippers={name: Path(file) for name, file in grippers.items()}, rate_hz=rate_hz)


def find_scenes(
    recordings: Sequence[Episode],
    *,
    size: tuple[float, float] | None = None,
    mesh: str | Path | None = None,
    density: float | tuple[float, float] | None = None,
    grip: float | None = None,
) -> list[Scene]:
    """Build a scene for each recording of a cloth, which first lies flat or hangs from the gripper.

    Args:
        size: side lengths of a rectangle [m]. Default: estimated from the first frames.
        mesh: OBJ file of a cloth of another shape, in metres, at rest in this shape.
        density: mass per area [kg/m²] of the weighed cloth, or (value, standard deviation). Default: estimated by the
            fit.
        grip: side of the gripper's pad [m]. Default: 20 mm, refined by the fit.

    Raises:
        EpisodeError: a recording shows something else. The message has the reason.
        ConfigError, MeshError: size and mesh are both given, or the mesh cannot be a cloth.
    """
    weighed = None if density is None else density if isinstance(density, tuple) else (float(density), 0.0)
    fields = found_cloth(recordings, size, None if weighed is None else weighed[0], None if mesh is None else Path(mesh))
    cloth: dict[str, Any] = {name: found.value for name, found in fields.items()}
    if grip is not None:
        cloth |= {"grip_m": grip} if starts_hanging(cloth) else known_grip(grip)
    if weighed is not None and weighed[1]:
        cloth = with_density(cloth, *weighed)
    scenes = list[Scene]()
    for number, recording in enumerate(recordings, 1):
        layout = found_layout(recording, cloth)
        for message in layout.warnings:
            warnings.warn(f"Recording {number}: {message}.", stacklevel=2)
        options = {**cloth, **{name: found.value for name, found in layout.fields.items()}}
        scenes.append(Scene(f"recording_{number}", options))
    settings = fit_settings(None, scenes[0].scenario, weighed)
    return [replace(scene, settings=settings) for scene in scenes]


def fit(
    recordings: Episode | Sequence[Episode],
    scenes: Scene | Sequence[Scene],
    settings: FitSettings | None = None,
    *,
    progress: Callable[[Progress], None] | None = None,
) -> Fit:
    """Estimate the parameters of one cloth from one or several recordings. Ctrl-C returns the best result so far.

    Args:
        scenes: one for each recording.
        settings: Default: those of the first scene.
        progress: called after each step.

    Raises:
        ConfigError, EpisodeError: recordings, scenes and settings are inconsistent.
        DivergedError: the simulation diverges from every start.
        KeyboardInterrupt: Ctrl-C before the first step.
    """
    episodes = [recordings] if isinstance(recordings, Episode) else list(recordings)
    chosen = [scenes] if isinstance(scenes, Scene) else list(scenes)
    if len(episodes) != len(chosen) or not episodes:
        raise ConfigError(f"Each recording takes one scene; got {len(episodes)} recordings and {len(chosen)} scenes.")
    names = [scene.name for scene in chosen]
    if len(set(names)) < len(names):
        raise ConfigError(f"Two scenes are named {max(names, key=names.count)}; give each a name of its own.")
    pairs = zip(chosen, episodes, strict=True)
    members = [Recording(scene.scenario, scene.name, _as_fitted(scene, episode)) for scene, episode in pairs]
    settings = settings or chosen[0].settings
    result = FitTask(members, settings).fitted(
        progress, None if progress is None else lambda done, doing, told: progress(told)
    )
    record = result.record
    told = record.estimate
    if told is not None and told.grip_m is not None:
        chosen = [replace(scene, options={**scene.options, **known_grip(told.grip_m)}) for scene in chosen]
    scenario = chosen[0].scenario
    level, factor = settings.level, settings.identified_factor
    intervals = None if told is None else intervals_of(record, space_of(record), scenario, level=level, within=factor)
    return Fit(
        parameters=_estimates(record, intervals, scenario, level),
        status=_status(record, intervals),
        residual=record.rms_mm / 1e3,
        horizons={} if told is None else dict(zip(names, (one.horizon_s for one in told.recordings), strict=True)),
        scenes=tuple(chosen),
        record=record,
        intervals=intervals,
        motions=tuple(result.motions),
    )


def _as_fitted(scene: Scene, episode: Episode) -> Episode:
    """The recording in the form in which fits of this scene take it."""
    return prepared(episode)[0] if starts_hanging({"base": "lift", **scene.options}) else episode


def _estimates(record: FitRecord, intervals: Intervals | None, scenario: Scenario, level: float) -> dict[str, Estimate]:
    sources = {} if intervals is None else intervals.sources
    return {
        name: Estimate(
            one["value"],
            one["unit"],
            None if intervals is None else (one["low"], one["high"]),
            level,
            one["status"] or "",
            dict(sorted(((source, row[name]) for source, row in sources.items()), key=lambda part: -part[1])),
        )
        for name, one in stated_parameters(record, intervals, scenario).items()
    }


def _status(record: FitRecord, intervals: Intervals | None) -> str:
    if record.stop_reason == "interrupted":
        return "interrupted"
    if intervals is not None and not intervals.fits_to_noise:
        return "model_error"
    if record.stop_reason not in ("converged", "threshold"):
        return "not_converged"
    return "fits_to_noise" if intervals is not None else "no_uncertainty"


def report(fit: Fit, recordings: Episode | Sequence[Episode], path: str | Path) -> Path:
    """Write the HTML report of a fit: status, intervals, and a player of recorded clouds and fitted cloths.

    Args:
        recordings: the recordings of the fit, in the same order.
        path: HTML file to write.

    Returns:
        The path.

    Raises:
        ConfigError, EpisodeError: the recordings are not those of the fit.
    """
    episodes = [recordings] if isinstance(recordings, Episode) else list(recordings)
    if len(episodes) != len(fit.scenes):
        raise ConfigError(f"The fit is of {len(fit.scenes)} recordings, got {len(episodes)}.")
    pairs = zip(fit.scenes, episodes, strict=True)
    members = [Recording(scene.scenario, scene.name, _as_fitted(scene, episode)) for scene, episode in pairs]
    status = Status.interrupted if fit.status == "interrupted" else Status.finished
    told = Told(fit.record, compared(fit.record, members), fit.intervals, status)
    page = page_of(told, summary_of(told), {one.name: one.episode for one in members}, fit.motions)
    write_text(Path(path), page)
    return Path(path)


def export(fit: Fit, to: str, out: str | Path, *, recording: int = 0, samples: int = 0, seed: int = 0) -> Path:
    """Export the fitted cloth to another simulator: mesh, material in SI units, and the motion of the grasped nodes.

    Args:
        to: mujoco, newton, isaac, arcsim, or obj.
        out: folder. Other files in it are kept.
        recording: index of the recording whose motion is exported.
        samples: number of additional cloths from the posterior (`Fit.sample`), in `sample_0000` and so on.

    Returns:
        The folder.

    Raises:
        SceneError: the target simulator does not support something in the scene.
        ConfigError: samples are requested, but the fit has no intervals.
    """
    out, one, scenario = Path(out), fit.record.episodes[recording], fit.scenes[recording].scenario
    motion, values, drawn = fit.motions[recording], fit.record.values, list[dict[str, float]]()
    if samples:
        if fit.intervals is None:
            raise ConfigError("Only a fit by the solver likelihood knows how uncertain it is; leave samples out.")
        drawn = [{**values, **each} for each in draws(fit.intervals, space_of(fit.record).asked, samples, seed)]
    with together():
        write_export(fitted_cloth(one, motion, scenario, values), to, out, described(one, scenario, values))
        write_samples(one, motion, scenario, drawn, to, out, {})
    return out


def sample_surface(nodes: Tensor, faces: Any, count: int, *, seed: int = 0) -> Tensor:
    """Sample points on a surface, uniformly by area of the first mesh in the batch. Differentiable in the nodes.

    Args:
        nodes: [..., V, 3]
        faces: [F, 3]
        seed: the same seed gives the same positions on the surface.

    Returns:
        [..., count, 3]
    """
    generator = torch.Generator().manual_seed(seed)
    sampler = SurfaceSampler.build(torch.as_tensor(np.asarray(faces)), count, generator=generator, dtype=nodes.dtype)
    return sampler.sample(nodes)


def chamfer(points: Tensor, target: Any) -> Tensor:
    """Mean squared distance from points to the nearest recorded points (the paper's one-sided Chamfer distance).

    The result is differentiable in the points.

    Args:
        points: [..., N, 3] [m]
        target: [M, 3] recorded points [m]

    Returns:
        [...] [m²]
    """
    return one_sided_chamfer(points, NeighbourIndex(torch.as_tensor(np.asarray(target), dtype=points.dtype)))
