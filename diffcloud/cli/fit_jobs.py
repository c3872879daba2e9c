"""Fits as jobs: which recordings belong to one, what it writes, and what of an earlier call is kept."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path, PurePosixPath

from diffcloud.cli.console import assignments, episode_files, errors, told_progress
from diffcloud.cli.scenario_options import choose_scenario
from diffcloud.cli.workers import Tell, check_interrupt
from diffcloud.errors import ConfigError
from diffcloud.estimation import Progress, read_fit, write_fit
from diffcloud.estimation.record import FitRecord
from diffcloud.estimation.result import FitResult
from diffcloud.estimation.settings import FitSettings
from diffcloud.estimation.task import FitTask, Recording
from diffcloud.io.episodes import read_episode
from diffcloud.io.files import read_yaml
from diffcloud.io.fingerprints import fingerprint
from diffcloud.io.manifests import read_manifest, remove_files, write_manifest
from diffcloud.io.timings import timings_path
from diffcloud.scene.scenarios import Scenario

JOINT = "joint"
"""Name of the fit of one parameter set to all recordings."""
_CODE = ("mesh", "io", "sim", "scene", "clouds", "estimation")
"""Packages whose source decides the numbers of a fit."""
_MOST_RECORDINGS = 1000


def fit_file(fits: Path, scenario: str, name: str) -> Path:
    """JSON of a fit: a joint one over several scenarios lies beside their folders."""
    path = fits / scenario / f"{name}.json"
    return path if path.is_file() or name != JOINT else fits / f"{name}.json"


def joint_fit(fits: Path) -> list[Path]:
    """The JSON of a joint fit over all scenarios, if there is one."""
    path = fits / f"{JOINT}.json"
    return [path] if path.is_file() else []


def stated_recordings(arguments: Sequence[Path]) -> list[tuple[str, Path]] | None:
    """(scenario, episode file or folder) of arguments SCENARIO=PATH, or of a YAML file that maps scenarios to such paths;
    None if they are neither.

    Raises:
        ConfigError: some are and others are not, or the file is no such list.
    """
    if len(arguments) == 1 and arguments[0].suffix in (".yaml", ".yml"):
        return _listed(arguments[0])
    if all(argument.exists() for argument in arguments):  # an equals sign may be a part of a name
        return None
    pairs = [str(argument).partition("=") for argument in arguments]
    if not any(equals for _, equals, _ in pairs):
        return None
    if not all(scenario and equals and path for scenario, equals, path in pairs):
        raise ConfigError("Give each episode its scenario, as in lift=a.npz fold=b.npz, or none and --scenario.")
    return [(scenario, Path(path)) for scenario, _, path in pairs]


def _listed(path: Path) -> list[tuple[str, Path]]:
    told, found = read_yaml(path, error=ConfigError), []
    for scenario, files in told.items() if isinstance(told, dict) else ():
        for file in files if isinstance(files, list) else [files]:
            if not (isinstance(file, str) and file):
                raise ConfigError(
                    f"{path}: {scenario} takes the path of an episode or of a folder of them, or a list of such paths, "
                    f"got {files!r}."
                )
            found.append((str(scenario), path.parent / file))
    if not 0 < len(found) <= _MOST_RECORDINGS:
        raise ConfigError(
            f"{path} lists {len(found)} episodes or folders; it takes 1 to {_MOST_RECORDINGS}, by scenario: "
            "`lift: [a.npz, b.npz]`."
        )
    return found


def read_recordings(pairs: Sequence[tuple[str, Path]]) -> list[Recording]:
    """
    Args:
        pairs: scenario, and an episode file, or a folder that stands for every episode in it.

    Raises:
        ConfigError, EpisodeError: an unknown scenario, a folder without episodes, a damaged episode, or two of one name in
            a scenario.
    """
    scenarios = {name: choose_scenario(name) for name in dict.fromkeys(name for name, _ in pairs)}
    files = [(name, file) for name, path in pairs for file in episode_files([path])]
    for name in scenarios:
        episode_files([file for one, file in files if one == name])
    return [Recording(scenarios[name], file.stem, read_episode(file)) for name, file in told_progress("reading", files)]


@dataclass(frozen=True)
class FitJob:
    """A fit with its files. A finished one of the same inputs by the same code is kept."""

    name: str
    recordings: Sequence[Recording]
    settings: FitSettings
    folder: Path
    init: Mapping[str, float] = field(default_factory=dict)
    """Values of the first start; the middle of the range where not given."""

    @cached_property
    def task(self) -> FitTask:
        return FitTask(self.recordings, self.settings, self.init)

    @property
    def scenario(self) -> Scenario:
        """Of the first recording."""
        return self.recordings[0].scenario

    @property
    def label(self) -> str:
        several = len({recording.scenario.name for recording in self.recordings}) > 1
        return self.name if several else f"{self.scenario.name}/{self.name}"

    @property
    def files(self) -> tuple[Path, Path]:
        """What `run` writes."""
        return self.folder / f"{self.name}.json", self.folder / f"{self.name}.npz"

    def known(self) -> FitRecord | None:
        """What this job, or an earlier one of the same inputs and code, has left; maybe interrupted."""
        try:
            record = read_fit(self.files[0])
        except ConfigError:  # none, or a damaged one
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
        unit_mm, asked = 1e3 * self.scenario.length_unit_m, self.task.space.asked.names

        def show(doing: str, progress: Progress) -> None:
            """No part that is done: how many starts there will be is not known."""
            check_interrupt()
            values = "  ".join(f"{key} {progress.values[key]:.3g}" for key in asked if key in progress.values)
            step = progress.iteration if progress.simulations is None else progress.simulations
            tell(0.0, f"{doing}step {step}  best {unit_mm * progress.best**0.5:.2f} mm  {values}")

        def show_left_out(done: float, doing: str, progress: Progress) -> None:
            show(f"{doing}  ", progress)

        result = self.task.fitted(partial(show, ""), show_left_out)
        record = self._written(result)
        if result.pressed or record.stop_reason == "interrupted":
            raise KeyboardInterrupt
        return record

    def begun(self) -> FitRecord:
        """The place where the fit begins, written and returned as a fit that was interrupted there: for who has been
        interrupted before the first loss, and must tell something.

        Raises:
            DivergedError: the motion diverges there.
        """
        return self._written(self.task.begun())

    def _written(self, result: FitResult) -> FitRecord:
        result.record.fingerprint = self._fingerprint
        write_fit(self.folder, self.name, result)
        return result.record

    @cached_property
    def _fingerprint(self) -> str:
        settings = self.settings.model_dump(exclude={"joint"})  # which the name and the recordings tell
        resolved = [
            self.task.space,
            self.task.solver_settings,
        ]  # with defaults from outside of these packages
        return fingerprint([self.name, self.recordings, settings, resolved], packages=_CODE)


def first_start(init: str, job: FitJob) -> dict[str, float]:
    """Values of the first start by name; recordings of a joint fit give the mean of their predictions.

    Raises:
        ConfigError: a value of what is not fitted, or outside of its bounds.
    """
    if init == "middle":
        return {}
    if "=" in init:
        stated = assignments(init.split(","), "--init")
        job.task.space.check_start(stated)
        return stated
    # imported here: the fits of the pipeline start elsewhere, and must not be stale when a regressor changes
    from diffcloud.cli.predict import predicted_start

    found = [predicted_start(init, one.scenario.name, one.episode) for one in job.recordings]
    return job.task.space.nearest({name: sum(values[name] for values in found) / len(found) for name in found[0]})


def remove_stale(out: Path, jobs: Sequence[FitJob]) -> None:
    """Remove fits that an earlier call left there and that this one's inputs no longer give: of episodes that are gone, or
    with other settings. Finished single fits stay beside a joint one, and the reverse."""
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
