"""How often intervals hold the truth, over the whole chain from a drawn cloth to its interval."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import torch
import typer
from rich.table import Table

from diffcloud.cli.options import JsonFlag, ParamsFile, Workers
from diffcloud.console import errors, finish, show, warn, writes
from diffcloud.errors import ConfigError, DiffCloudError, OutputError
from diffcloud.estimation.pose import SET_UP, PoseSpace
from diffcloud.estimation.result import describe_fit
from diffcloud.estimation.task import Recording
from diffcloud.evaluation.intervals import intervals_of
from diffcloud.io.episodes import Episode, read_episode, write_episode
from diffcloud.io.files import files_in, read_json, write_json, write_text
from diffcloud.io.fingerprints import fingerprint, kept_record
from diffcloud.jobs.fits import FitJob
from diffcloud.jobs.pool import Tell, run_all
from diffcloud.jobs.preprocess import PreprocessJob
from diffcloud.jobs.scenarios import choose_scenario
from diffcloud.jobs.settings import Config, SynthesizeConfig, load_config
from diffcloud.jobs.synthesize import hidden_parameters, record_motion, simulated_frames
from diffcloud.scene.scenarios import Scenario
from diffcloud.sensing.depth_camera import DepthNoise
from diffcloud.settings import updated
from diffcloud.sim.properties import PARAMETERS
from studies.coverage_page import (
    HEAD,
    REFIT_HEAD,
    REFITS,
    cells_of,
    counts_of,
    coverage_page,
    level_of,
    refit_rows,
    summary,
)

if TYPE_CHECKING:
    from diffcloud.regressors import Regressor

_RECORDS = ("mesh", "io", "sim", "scene", "clouds", "sensing")
"""Packages whose source decides what is recorded."""
_CODE = (*_RECORDS, "estimation", "evaluation")
_FINER_STEPS = 4
"""Times as many steps of the truths `refined` and `finer`."""
_PLACE_M = 0.01
"""Deviation by which a cloth lies off its place."""
Truth = Literal["same", "refined", "finer"]
_OTHER_NOISE = DepthNoise(subpixel_px=0.1, correlation_px=1.5, step_px=1 / 16, edge_dropout=0.5, flying=0.2, holes=0.01)
"""Of cameras that are worse than the noise model says: errors of more pixels go together, disparity has coarser steps, and
more of the borders is lost or lands in between."""
_OTHER_NOISE_M = 0.001
"""And of whole surfaces, which otherwise have none: a deviation along each axis."""


@writes()
def coverage(
    out: Annotated[
        Path, typer.Option(help="Folder for episodes and <scenario>/<known>/<number>.json, which a later call reuses.")
    ],
    scenario: Annotated[list[str] | None, typer.Option(help="Repeatable; by default those of the parameters file.")] = None,
    recordings: Annotated[
        int, typer.Option(min=1, max=10_000, help="Cloths of each scenario, each recorded once (more often with --refits).")
    ] = 200,
    seed: Annotated[int, typer.Option(min=0, help="Of truths and noise.")] = 0,
    fix: Annotated[list[str] | None, typer.Option(help="Parameter whose true value fits are given, repeatable.")] = None,
    level: Annotated[float | None, typer.Option(min=0.01, max=0.999, help="Of the intervals. Default: 0.9.")] = None,
    refits: Annotated[
        int | None,
        typer.Option(
            min=2,
            help="Recordings of each cloth, each fitted on its own: stretching and density stay, all else is drawn anew.",
        ),
    ] = None,
    truth: Annotated[
        Truth,
        typer.Option(
            help="How the truth is simulated and recorded. same: as fits do it; refined: with four times their steps and "
            "noise that they do not expect; finer: like refined, and on a mesh of half the edge length."
        ),
    ] = "same",
    checkpoint: Annotated[
        list[Path] | None,
        typer.Option(help="Written by `diffcloud network train`, repeatable: what it predicts of the same recordings."),
    ] = None,
    markdown: Annotated[Path | None, typer.Option(help="Write all that the folder holds to this page.")] = None,
    workers: Workers = None,
    params: ParamsFile = None,
    json: JsonFlag = False,
) -> None:
    """Draw cloths, record and fit them, and count how often the stated intervals hold the truth.

    Stretching and density are drawn as `python -m pipeline.synthesize` draws them. Material that is not fitted is off
    by the factors of `fit.uncertain`, cameras and clock by what fits assume of a calibrated set-up (2 mm, 0.3°, 2 ms). The
    cloth lies about a centimetre beside its place. A recording whose fit fails or gets no interval counts as a miss.
    """
    config = load_config(params)
    known = tuple(fix or ())
    for name in known:
        if name not in config.fit.parameters:
            raise ConfigError(f"--fix names a fitted parameter, one of {', '.join(config.fit.parameters)}, not {name!r}.")
    if set(known) >= set(config.fit.parameters):
        raise ConfigError("Nothing is left to fit: leave out a --fix.")
    if refits and checkpoint:
        raise ConfigError("--checkpoint takes one recording of each cloth; leave out --checkpoint or --refits.")
    jobs = [
        CoverageJob(choose_scenario(name), index, seed, known, level or config.fit.level, truth, config, out, refit)
        for name in scenario or config.scenes
        for index in range(recordings)
        for refit in (range(refits) if refits else (None,))
    ]
    readers = _regressors(checkpoint or (), jobs)
    for job in {job.folder: job for job in jobs}.values():
        job.check()
    failures = []
    for job, _, error in run_all("coverage", jobs, workers):
        if error is not None:
            failures.append(f"{job.label}: {error}")
            errors.print(failures[-1], soft_wrap=True)
    for regressor in readers:
        _predict(regressor, jobs)
    for folder in dict.fromkeys(job.folder for job in jobs):
        others = {*files_in(folder, ".json")} - {job.path for job in jobs}
        if others:
            warn(f"{folder} holds {len(others)} records of earlier calls too. They count, whatever they were made with.")
    counts = counts_of(out)
    for head, rows in ((HEAD, summary(list(cells_of(counts)))), (REFIT_HEAD, list(refit_rows(counts)))):
        if rows:
            table = Table(*head)
            for row in rows:
                table.add_row(*row)
            show(table, json)
    if markdown is not None:
        write_text(markdown, coverage_page(counts))
    asked = {
        f"{job.scenario.name}/{job.folder.name}": counts.get((job.scenario.name, job.folder.name), {"parameters": {}})
        for job in jobs
    }
    result = next(iter(asked.values())) if len(asked) == 1 else {"scenes": asked}
    finish({"out": str(out), "level": jobs[0].level, **result, "failures": failures}, json)


@dataclass(frozen=True)
class CoverageJob:
    """One drawn cloth: recorded, fitted, and its interval held against the truth. A finished one is kept."""

    scenario: Scenario
    index: int
    seed: int
    known: tuple[str, ...]
    level: float
    kind: Truth
    """How the truth is simulated and recorded."""
    config: Config
    out: Path
    refit: int | None = None
    """Number of the recording of this cloth; None: its only one."""

    @property
    def name(self) -> str:
        return f"{self.index:04d}" if self.refit is None else f"{self.index:04d}_{self.refit:02d}"

    @property
    def label(self) -> str:
        return f"{self.scenario.name}/{self.name}"

    @property
    def folder(self) -> Path:
        told = [*self.known, "known"] if self.known else ["free"]
        return self.out / self.scenario.name / "_".join([*told, *self.marks])

    @property
    def path(self) -> Path:
        """Of the record."""
        return self.folder / f"{self.name}.json"

    @property
    def marks(self) -> list[str]:
        """What distinguishes the recordings, as names of folders have it."""
        return [self.kind] * (self.kind != "same") + [REFITS] * (self.refit is not None)

    def run(self, tell: Tell) -> dict[str, Any]:
        """The finished record.

        Raises:
            DiffCloudError: the cloth cannot be simulated, recorded or fitted; the record says so.
        """
        path = self.path
        truth, set_up = self.truth(), self.set_up()
        plan = [self.scenario, self.index, self.refit, self.seed, self.known, self.level, self.kind]
        plan += [self.config.fit.identified_factor]
        plan += [truth, set_up, self._noise]
        sections = [self.config.synthesize, self.config.preprocess, self.config.fit]
        mark = fingerprint([*plan, [str(section) for section in sections]], packages=_CODE)
        record = kept_record(path, mark)
        if record is None:
            record = {"fingerprint": mark, "truth": truth, "set_up": set_up}
            try:
                record |= self._measured(record["truth"], tell)
            except OutputError:  # a full disk says nothing of the cloth
                raise
            except DiffCloudError as error:
                record["error"] = str(error)
            write_json(path, record)
        if "error" in record:
            raise DiffCloudError(str(record["error"]))
        return record

    def check(self) -> None:
        """
        Raises:
            ConfigError: a fitted parameter that is not drawn, or may be zero; or records of another level in the folder.
        """
        stated = {**self.scenario.bounds, **self.config.fit.bounds}
        drawn = [name for name in self.truth() if stated.get(name, PARAMETERS[name].bounds)[0] > 0]
        for name in self.config.fit.parameters:
            if name not in drawn:
                raise ConfigError(
                    f"fit.parameters: coverage counts errors of the logarithm of what it draws and bounds keep above zero: "
                    f"{', '.join(drawn)} in {self.scenario.name}, not {name}."
                )
        level = level_of(self.folder, [read_json(path) for path in files_in(self.folder, ".json")])
        if level not in (None, self.level):
            raise ConfigError(f"{self.folder} holds intervals of the level {level:g}. Choose another --out.")

    def truth(self) -> dict[str, float]:
        """All that is drawn, name -> value."""
        rng = np.random.default_rng([self.seed, self.index])
        drawn = hidden_parameters(self.scenario, self.config.synthesize.model_copy(update={"per_scenario": 1}), rng)
        if self.refit is not None:
            rng = self._random(3)
        found = {name: float(value[0]) for name, value in drawn.items()}
        fit = self.config.fit
        drawn_too = fit.model_copy(update={"parameters": [name for name in fit.parameters if name in found]})
        for name, factor in drawn_too.known_within([self.scenario]).items():
            off, value = rng.lognormal(0.0, math.log(factor)), self.scenario.value(name)
            if name not in found and value:
                found[name] = value * off
        return found

    def set_up(self) -> dict[str, float]:
        """Errors of the set-up, drawn as fits assume it, name of `estimation.pose` -> value [m, rad, s]; and how far
        beside its place the cloth lies with its gripper, `place_x` and `place_y` [m]."""
        rng = self._random(2)
        deviations = {**SET_UP, "place_x": _PLACE_M, "place_y": _PLACE_M}
        return {name: deviation * float(rng.standard_normal()) for name, deviation in deviations.items()}

    def _random(self, *stream: int) -> np.random.Generator:
        """Of this recording of the cloth."""
        return np.random.default_rng([self.seed, self.index, *stream, *([] if self.refit is None else [self.refit])])

    def _measured(self, truth: Mapping[str, float], tell: Tell) -> dict[str, Any]:
        episode = self.episode(truth, tell)
        tell(0.5, "fit")
        fit = self.config.fit
        fixed = {**fit.fixed, **self.scenario.in_si({name: truth[name] for name in self.known})}
        solver = {**fit.solver.model_dump(), "model_error": self.kind != "same"}
        fit = updated(fit, fixed=fixed, solver=solver)
        job = FitJob(self.label, [Recording(self.scenario, self.label, episode)], fit, self.folder)
        objective, outcome = job.task.solved()
        outcome = outcome.uninterrupted()
        fitted = describe_fit(objective, job.task.space, job.task.solver_settings, outcome, episodes=[self.label]).record
        found = intervals_of(
            fitted, job.task.space, self.scenario, level=self.level, within=self.config.fit.identified_factor
        )
        told: dict[str, Any] = {
            "loss": outcome.loss,
            "values": outcome.values,
            "stop_reason": outcome.stop_reason,
            "simulations": outcome.simulations,
        }
        return told | {"seconds": outcome.seconds, "intervals": found.model_dump(mode="json")}

    @property
    def _noise(self) -> tuple[DepthNoise | None, float]:
        """Of depth cameras, None for their usual one; and along each axis, of points of whole surfaces [m]."""
        return (None, 0.0) if self.kind == "same" else (_OTHER_NOISE, _OTHER_NOISE_M)

    def _true_scenario(self) -> Scenario:
        """With the steps and the mesh of the truth."""
        true = self.scenario if self.kind == "same" else self.scenario.with_steps(_FINER_STEPS)
        return true.finer() if self.kind == "finer" else true

    def episode(self, truth: Mapping[str, float], tell: Tell) -> Episode:
        """Recorded and preprocessed; fits with other known parameters share it."""
        path = self.out / self.scenario.name / "_".join(["episodes", *self.marks]) / f"{self.name}.npz"
        told = [self.scenario, self.index, self.refit, self.seed, self.kind]
        told += [str(self.config.synthesize), str(self.config.preprocess)]
        set_up = self.set_up()
        made = fingerprint([*told, dict(truth), set_up, self._noise], packages=_RECORDS)
        if path.is_file() and (kept := read_episode(path)).meta.get("made") == made:
            return kept
        meta = {
            "scenario": self.scenario.name,
            "fabric": f"drawn{self.index}",
            "repeat": 1,
            "truth": dict(truth),
        }
        tell(0.0, "recording")
        sets = {name: np.array([value]) for name, value in truth.items()}
        system, (nodes,), times = simulated_frames(self._true_scenario(), sets)
        rng = self._random(1)
        seed = int(rng.integers(2**31))
        with TemporaryDirectory(prefix="diffcloud-") as folder:
            work = Path(folder)
            config = _misplaced(self.config.synthesize, set_up)
            noise, _ = self._noise
            record_motion(self.scenario, system, nodes, times, work, path.stem, config, seed=seed, meta=meta, noise=noise)
            source = work / path.stem if (work / path.stem).is_dir() else work / path.name
            tell(0.25, "preprocessing")
            PreprocessJob("clean", source, work, self.config.preprocess, None).run(lambda done, text: None)
            episode = read_episode(work / "clean" / path.name)
        if self.scenario.recorder == "whole_surface":
            episode = _displaced(episode, set_up)
            _, noise_m = self._noise
            if noise_m:
                shaken = episode.points + noise_m * rng.standard_normal(episode.points.shape)
                episode = replace(episode, points=shaken.astype(np.float32))
        # here, not in `meta`: a raw recording carries only keys of its own on to its clouds
        episode = replace(episode, meta={**episode.meta, "made": made})
        write_episode(path, episode)
        return episode


def _misplaced(config: SynthesizeConfig, set_up: Mapping[str, float]) -> SynthesizeConfig:
    """What depth cameras record with these errors, in directions of the recorder's own."""
    moved, turned, placed = (
        math.hypot(*(set_up[name] for name in names))
        for names in (("x", "y", "z"), ("tilt_x", "tilt_y", "yaw"), ("place_x", "place_y"))
    )
    lag = max(config.clock_offset_s + set_up["lag"], 0.0)
    changes = {
        "rig_error": (1e3 * moved, math.degrees(turned)),
        "placement_error": (1e3 * placed, 0.0),
        "clock_offset_s": lag,
    }
    return config.model_copy(update=changes)


def _displaced(episode: Episode, set_up: Mapping[str, float]) -> Episode:
    """An episode as it would be seen with these errors."""
    points = torch.from_numpy(episode.points.astype(np.float64))
    names = tuple(name for name in SET_UP if name != "lag")
    space = PoseSpace.build(dict.fromkeys(names, 1.0), points.mean(0), length_unit_m=1.0)
    values = [set_up[name] + set_up.get(f"place_{name}", 0.0) for name in names]
    moved = space.moved(points[None], torch.tensor([values], dtype=torch.float64))[0]
    times = episode.times.copy()
    times[1:] -= set_up["lag"]
    return replace(episode, points=moved.numpy().astype(np.float32), times=times)


def _regressors(checkpoints: Sequence[Path], jobs: Sequence[CoverageJob]) -> list[Regressor]:
    """
    Raises:
        CheckpointError, ConfigError: a damaged checkpoint, or one of a scenario whose cloths are not drawn.
    """
    if not checkpoints:
        return []
    from diffcloud.regressors import Regressor  # takes seconds to import

    found = [Regressor.read(path) for path in checkpoints]
    for path, regressor in zip(checkpoints, found, strict=True):
        if (scenario := regressor.description.scenario) not in {job.scenario.name for job in jobs}:
            raise ConfigError(f"{path} was trained for {scenario}, which is not among the scenarios.")
    kinds = [(one.description.scenario, one.description.model) for one in found]
    if len(set(kinds)) < len(kinds):
        raise ConfigError(
            "Two checkpoints are of one kind of network and one scenario: count them in folders of their own."
        )
    return found


def _predict(regressor: Regressor, jobs: Sequence[CoverageJob]) -> None:
    """Records of a network's predictions, beside those of the fits: <scenario>/<model>/<number>.json."""
    from diffcloud.regressors import predict_episode

    told = regressor.description
    for job in (job for job in jobs if job.scenario.name == told.scenario):
        truth = job.truth()
        try:
            found = predict_episode(regressor, job.episode(truth, lambda done, text: None))
        except DiffCloudError as error:
            record: dict[str, Any] = {"error": str(error)}
        else:
            ends = zip(found.values[0].tolist(), found.first_intervals(job.level).items(), strict=True)
            parameters = {
                name: {"value": value, "low": low, "high": high, "nominal": 1.0} for value, (name, (low, high)) in ends
            }
            stated = {"parameters": parameters, "within": job.config.fit.identified_factor, "level": job.level}
            record = {"intervals": stated}
            if found.samples is not None and {"stretching", "density"} <= set(told.names):
                stretching, density = (found.samples[0, :, told.names.index(name)] for name in ("stretching", "density"))
                ends = np.quantile((stretching / density).numpy(), [0.5, 0.5 - job.level / 2, 0.5 + job.level / 2])
                record["intervals"]["ratio"] = {
                    "nominal": 1.0,
                    **dict(zip(("value", "low", "high"), ends.tolist(), strict=True)),
                }
        folder = job.out / job.scenario.name / "_".join([told.model, *job.marks])
        write_json(folder / f"{job.index:04d}.json", {"truth": truth, **record})
