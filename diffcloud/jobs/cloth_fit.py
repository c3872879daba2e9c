"""A fit of one cloth with its files: OUT/fit.json, fit.npz, intervals.json, report.html, and scenes/."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml

from diffcloud.console import progress_bar
from diffcloud.errors import DiffCloudError
from diffcloud.estimation.record import FitRecord
from diffcloud.estimation.result import read_motion
from diffcloud.estimation.settings import FitSettings
from diffcloud.estimation.task import Recording, compared
from diffcloud.evaluation.intervals import Intervals, intervals_of
from diffcloud.evaluation.methods import space_of
from diffcloud.identification import known_grip
from diffcloud.io.files import together, write_bytes, write_json, write_text
from diffcloud.jobs import ctrl_c
from diffcloud.jobs.fits import FitJob
from diffcloud.jobs.pool import check_interrupt
from diffcloud.jobs.scene_files import read_fields
from diffcloud.reporting.fit_page import Status, Told, page_of, summary_of
from diffcloud.reporting.page import Summary
from diffcloud.scene.scenarios import load_scenario
from diffcloud.sim import warm


@dataclass(frozen=True)
class ClothFit:
    """What is fitted, and where it is written."""

    members: Sequence[Recording]
    settings: FitSettings
    out: Path
    scenes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Scenario -> its fields, of those that later commands can find beside the fit only."""
    init: Mapping[str, float] = field(default_factory=dict)
    """Values of the first start."""

    @property
    def job(self) -> FitJob:
        return FitJob("fit", self.members, self.settings, self.out / "stages", self.init)

    def run(self, seconds: float | None) -> tuple[Told, Summary]:
        """Fit and write. At Ctrl-C or the end of the time, the best so far is written.

        Args:
            seconds: for the fit; None: as long as it takes.

        Returns:
            The fit, and what a person reads of it first.

        Raises:
            DiffCloudError: the time was over before a first loss was known.
            KeyboardInterrupt: Ctrl-C before a first loss beside an earlier fit, or once more.
        """
        job, status = self.job, Status.finished
        job.task.check()  # what cannot be fitted leaves nothing behind
        for name, fields in self.scenes.items():
            write_text(self._scene(name), yaml.safe_dump(dict(fields), sort_keys=False))
        if seconds is not None:
            warm.implicit()  # a compilation, which is done once, is none of the time and cannot be interrupted
        record: FitRecord | None = None
        intervals: Intervals | None = None
        try:
            with ctrl_c.none_lost(), ctrl_c.pressed_after(seconds) as is_over, progress_bar("fit", None, seconds) as update:
                record = job.run(update)
                check_interrupt()
                intervals = self._intervals(record)
        except KeyboardInterrupt:
            status = Status.budget_reached if is_over() else Status.interrupted
            record = record or job.known()
            if record is None and not (self.out / "fit.json").exists():
                record = job.begun()  # an earlier run's fit is worth more than the place where this one begins
            if record is None and status == Status.budget_reached:
                raise DiffCloudError(
                    "The time of --budget was over before a first loss was known. The fit of an earlier run stays. Give "
                    "more time."
                ) from None
            if record is None:  # Ctrl-C once more, or before a first loss beside an earlier fit
                raise
        if intervals is None:  # what was reached has some, too
            intervals = self._intervals(record)
        told = Told(record, compared(record, self._with_grip_found(record)), intervals, status)
        summary = summary_of(told)
        self._write(told, summary)
        return told, summary

    def _scene(self, name: str) -> Path:
        """The file of a scenario of an unfinished fit."""
        return self.out / "stages" / "scenes" / f"{name}.yaml"

    def _intervals(self, record: FitRecord) -> Intervals | None:
        if record.estimate is None:
            return None
        chosen, scenario = self.settings, self.members[0].scenario
        return intervals_of(record, space_of(record), scenario, level=chosen.level, within=chosen.identified_factor)

    def _with_grip_found(self, record: FitRecord) -> list[Recording]:
        """The recordings in scenarios with the grasp that was found; their files have it too."""
        found = None if record.estimate is None else record.estimate.grip_m
        if found is None:
            return list(self.members)
        for name in self.scenes:
            path = self._scene(name)
            write_text(path, yaml.safe_dump({**read_fields(path), **known_grip(found)}, sort_keys=False))
        return [
            replace(one, scenario=load_scenario(self._scene(one.scenario.name)))
            if one.scenario.name in self.scenes
            else one
            for one in self.members
        ]

    def _write(self, told: Told, summary: Summary) -> None:
        out, files = self.out, self.job.files
        motions = [read_motion(files[1], index) for index in range(len(self.members))]
        page = page_of(told, summary, {one.name: one.episode for one in self.members}, motions)
        with together():
            for path in files:
                _copy(path, out / f"fit{path.suffix}")
            for name in self.scenes:
                _copy(self._scene(name), out / "scenes" / f"{name}.yaml")
            write_text(out / "report.html", page)
            if told.intervals is not None:
                write_json(out / "intervals.json", told.intervals.model_dump(mode="json"))
        if told.intervals is None:  # those of an earlier run are of another fit
            (out / "intervals.json").unlink(missing_ok=True)


def _copy(source: Path, target: Path) -> None:
    """Write nothing where nothing would change."""
    content = source.read_bytes()
    if not target.is_file() or target.read_bytes() != content:
        write_bytes(target, content)
