"""Fits as jobs: their recordings, their output files, and the reuse of finished results."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path, PurePosixPath

from diffcloud.console import episode_files, errors, told_progress, warn
from diffcloud.errors import ConfigError
from diffcloud.estimation.record import FitRecord, read_fit
from diffcloud.estimation.result import FitResult, write_fit
from diffcloud.estimation.settings import FitSettings
from diffcloud.estimation.solvers import Progress
from diffcloud.estimation.task import FitTask, Recording
from diffcloud.io.episodes import read_episode
from diffcloud.io.files import files_in, folders_in
from diffcloud.io.fingerprints import fingerprint
from diffcloud.io.manifests import read_manifest, remove_files, write_manifest
from diffcloud.io.timings import timings_path
from diffcloud.jobs.ctrl_c import none_lost
from diffcloud.jobs.pool import Tell, check_interrupt, run_all
from diffcloud.jobs.scenarios import choose_scenario
from diffcloud.scene.scenarios import Scenario
from diffcloud.sim.properties import PARAMETERS

JOINT = "joint"
"""Name of the joint fit of all recordings."""
_CODE = ("mesh", "io", "sim", "scene", "clouds", "estimation")
"""Packages whose source code affects the result of a fit."""
_MOST_JOINT = 100
"""Largest number of recordings in a joint fit. Each step of the fit simulates all of them."""


def fit_file(fits: Path, scenario: str, name: str) -> Path:
    """Return the JSON path of a fit. A joint fit of several scenarios is in `fits` itself."""
    path = fits / scenario / f"{name}.json"
    return path if path.is_file() or name != JOINT else fits / f"{name}.json"


def joint_fit(fits: Path) -> list[Path]:
    """Return the JSON path of the joint fit of all scenarios, if it exists, as a list."""
    path = fits / f"{JOINT}.json"
    return [path] if path.is_file() else []


@dataclass(frozen=True)
class FitJob:
    """A fit with its files. A finished result with the same inputs and code is reused."""

    name: str
    recordings: Sequence[Recording]
    settings: FitSettings
    folder: Path
    init: Mapping[str, float] = field(default_factory=dict)
    """Parameter values of the first start. Others start at mid-range."""

    @cached_property
    def task(self) -> FitTask:
        return FitTask(self.recordings, self.settings, self.init)

    @property
    def scenario(self) -> Scenario:
        """Scenario of the first recording."""
        return self.recordings[0].scenario

    @property
    def label(self) -> str:
        several = len({recording.scenario.name for recording in self.recordings}) > 1
        return self.name if several else f"{self.scenario.name}/{self.name}"

    @property
    def files(self) -> tuple[Path, Path]:
        """Output files (JSON, NPZ) of `run`."""
        return self.folder / f"{self.name}.json", self.folder / f"{self.name}.npz"

    def known(self) -> FitRecord | None:
        """Return an existing result with the same inputs and code, possibly of an interrupted fit, or None."""
        try:
            record = read_fit(self.files[0])
        except ConfigError:  # missing or damaged
            return None
        return record if record.fingerprint == self._fingerprint and self.files[1].is_file() else None

    def run(self, tell: Tell) -> FitRecord:
        """Fit, write, and return the record.

        Raises:
            DivergedError: every start diverged.
            KeyboardInterrupt: Ctrl-C; the best so far is written.
        """
        known = self.known()
        if known is not None and known.stop_reason != "interrupted":
            return known
        unit_mm, scenario = 1e3 * self.scenario.length_unit_m, self.scenario

        def show(doing: str, progress: Progress) -> None:
            """Report the current step. The fraction done stays 0, because the number of starts is not known in advance."""
            check_interrupt()
            shown = {name: progress.values[name] for name in self.settings.parameters if name in progress.values}
            values = "  ".join(
                f"{name} {value:.3g} {PARAMETERS[name].unit}" for name, value in scenario.in_si(shown).items()
            )
            step = progress.iteration if progress.simulations is None else progress.simulations
            tell(0.0, f"{doing}step {step}  residual {unit_mm * progress.best**0.5:.2f} mm  {values}")

        def show_left_out(done: float, doing: str, progress: Progress) -> None:
            show(f"{doing}  ", progress)

        result = self.task.fitted(partial(show, ""), show_left_out)
        record = self._written(result)
        if result.pressed or record.stop_reason == "interrupted":
            raise KeyboardInterrupt
        return record

    def begun(self) -> FitRecord:
        """Write and return the start of the fit, for an interrupt before the first loss evaluation.

        Raises:
            DivergedError: the simulation diverges at the start.
        """
        return self._written(self.task.begun())

    def _written(self, result: FitResult) -> FitRecord:
        result.record.fingerprint = self._fingerprint
        write_fit(self.folder, self.name, result)
        return result.record

    @cached_property
    def _fingerprint(self) -> str:
        # Whether the fit is joint follows from name and recordings. The last two settings only affect the report.
        settings = self.settings.model_dump(exclude={"joint", "level", "identified_factor"})
        resolved = [
            self.task.space,
            self.task.solver_settings,
        ]  # resolved, because defaults may come from other packages
        return fingerprint([self.name, self.recordings, settings, resolved], packages=_CODE)


def fit_all(
    episodes: Path,
    out: Path,
    scenarios: Sequence[str],
    settings: FitSettings,
    workers: int | None,
    scheduler: str | None = None,
) -> Iterator[tuple[FitJob, FitRecord | None, str | None]]:
    """Fit every episode, or all episodes jointly if the settings say so.

    Finished fits are reused. Fits whose episode was deleted are removed.

    Args:
        episodes: folder of <scenario>/<episode>.npz.
        out: folder for <scenario>/<episode>.json and .npz, or joint.json and joint.npz.

    Yields:
        Each fit with its record, or with an error message. After Ctrl-C, the best known results of the others.

    Raises:
        ConfigError, EpisodeError: there are no episodes, or one is damaged. Nothing has been fitted then.
        KeyboardInterrupt: Ctrl-C. The best result of each running fit is written.
    """
    jobs = _jobs(episodes, out, scenarios, settings)
    # Write the manifest first, so that it also lists files of an interrupted call.
    write_manifest(out, read_manifest(out) | {path.relative_to(out).as_posix() for job in jobs for path in job.files})
    done, failed = set[str](), False
    try:
        with none_lost():
            for job, record, error in run_all("fit", jobs, workers, patient=True, scheduler=scheduler):
                done.add(job.label)
                failed = failed or error is not None
                yield job, record, error
    except KeyboardInterrupt:
        for job in jobs:
            if job.label not in done and (best := job.known()) is not None:
                yield job, best, None
        raise
    if not failed:
        remove_stale(out, jobs)


def _jobs(episodes: Path, out: Path, scenarios: Sequence[str], settings: FitSettings) -> list[FitJob]:
    there = [name for name in scenarios if files_in(episodes / name, ".npz")]
    if not there:
        raise ConfigError(
            f"{episodes} holds no episodes of {', '.join(scenarios)}. They lie in <scenario>/<episode>.npz; run "
            "`python -m pipeline.preprocess` first."
        )
    if missing := [name for name in scenarios if name not in there]:
        errors.print(f"{episodes} has no episodes of {', '.join(missing)}.", soft_wrap=True)
    if more := [one.name for one in folders_in(episodes) if one.name not in scenarios and files_in(one, ".npz")]:
        warn(f"{episodes} also has episodes of {', '.join(more)}. They are not fitted: list them under `scenarios`.")
    chosen = {name: choose_scenario(name) for name in there}
    files = [(name, file) for name in there for file in episode_files([episodes / name])]
    members = [Recording(chosen[name], file.stem, read_episode(file)) for name, file in told_progress("reading", files)]
    if settings.joint and len(members) > _MOST_JOINT:
        raise ConfigError(f"A joint fit takes {_MOST_JOINT} episodes at most, got {len(members)}. Choose a part of them.")
    jobs = [FitJob(JOINT, members, settings, out)] if settings.joint else []
    if not settings.joint:
        jobs = [FitJob(one.name, [one], settings, out / name) for (name, _), one in zip(files, members, strict=True)]
    # Check everything before the first fit, so that a damaged last file does not waste the time of the others.
    for job in told_progress("checking", jobs):
        job.task.check()
    return jobs


def remove_stale(out: Path, jobs: Sequence[FitJob]) -> None:
    """Remove fits of earlier calls that do not belong to the present episodes and settings.

    Finished single fits are kept beside a joint fit, and vice versa.
    """
    if jobs[0].name == JOINT:
        others = [
            replace(job, name=one.name, recordings=[one], folder=out / one.scenario.name)
            for job in jobs
            for one in job.recordings
        ]
    else:
        every = [one for job in jobs for one in job.recordings]
        others = [replace(jobs[0], name=JOINT, recordings=every, folder=out)]
    kept = {path for job in jobs for path in job.files}
    kept |= {path for job in others if job.known() is not None for path in job.files}
    inside = {path.relative_to(out).as_posix() for path in kept}
    stale = sorted(read_manifest(out) - inside)
    timings = {timings_path(PurePosixPath(name)).as_posix() for name in stale}
    removed = remove_files(out, [*timings, *stale])
    write_manifest(out, inside)
    if told := [name for name in removed if name not in timings]:
        text = "Removed fits whose episode is gone or whose settings have changed"
        errors.print(f"{text}: {', '.join(told)}.", soft_wrap=True)
