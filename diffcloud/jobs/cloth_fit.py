"""Fit one cloth and write fit.json, fit.npz, intervals.json, report.html and scenes/ to the output folder."""

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
from diffcloud.scene.scenarios.catalogue import paths_within, with_paths
from diffcloud.sim import warm


@dataclass(frozen=True)
class ClothFit:
    """Recordings, settings and output folder of a fit."""

    members: Sequence[Recording]
    settings: FitSettings
    out: Path
    scenes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Scenario name -> fields of its YAML file, for scenarios that later commands can find only beside the fit."""
    init: Mapping[str, float] = field(default_factory=dict)
    """Parameter values of the first start."""

    @property
    def job(self) -> FitJob:
        return FitJob("fit", self.members, self.settings, self.out / "stages", self.init)

    def run(self, seconds: float | None) -> tuple[Told, Summary]:
        """Fit and write the results. After Ctrl-C or the time limit, the best fit so far is written.

        Args:
            seconds: time limit of the fit. None: no limit.

        Returns:
            The results, and the summary that a person reads first.

        Raises:
            DiffCloudError: the time limit was reached before the first loss evaluation.
            KeyboardInterrupt: Ctrl-C twice, or before the first loss evaluation if the folder has an earlier fit.
        """
        job, status = self.job, Status.finished
        job.task.check()  # before anything is written
        for name, fields in self.scenes.items():
            self._write_scene(self._scene(name), fields)
        if seconds is not None:
            warm.implicit()  # compile first: this cannot be interrupted, and should not count as fit time
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
                record = job.begun()  # the start of the fit; not written if there is a fit of an earlier run
            if record is None and status == Status.budget_reached:
                raise DiffCloudError(
                    "The time of --budget was over before a first loss was known. The fit of an earlier run stays. Give "
                    "more time."
                ) from None
            if record is None:  # Ctrl-C again, or before the first loss evaluation with an earlier fit in the folder
                raise
        if intervals is None:  # compute them for the interrupted fit too
            intervals = self._intervals(record)
        told = Told(record, compared(record, self._with_grip_found(record)), intervals, status)
        summary = summary_of(told)
        self._write(told, summary)
        return told, summary

    def _scene(self, name: str) -> Path:
        """Path of a scenario file while the fit is unfinished."""
        return self.out / "stages" / "scenes" / f"{name}.yaml"

    def _write_scene(self, path: Path, fields: Mapping[str, Any]) -> None:
        """Write a scenario file. Paths within the folder of the fit are relative, so that the folder can be moved."""
        _write_changed(path, yaml.safe_dump(paths_within(fields, path.parent, self.out), sort_keys=False).encode())

    def _intervals(self, record: FitRecord) -> Intervals | None:
        if record.estimate is None:
            return None
        chosen, scenario = self.settings, self.members[0].scenario
        return intervals_of(record, space_of(record), scenario, level=chosen.level, within=chosen.identified_factor)

    def _with_grip_found(self, record: FitRecord) -> list[Recording]:
        """Return the recordings with the estimated grasp in their scenarios, and update the scenario files."""
        found = None if record.estimate is None else record.estimate.grip_m
        if found is None:
            return list(self.members)
        for name in self.scenes:
            path = self._scene(name)
            self._write_scene(path, {**with_paths(read_fields(path), path.parent), **known_grip(found)})
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
                _write_changed(out / f"fit{path.suffix}", path.read_bytes())
            for name in self.scenes:
                fields = with_paths(read_fields(self._scene(name)), self._scene(name).parent)
                self._write_scene(out / "scenes" / f"{name}.yaml", fields)
            write_text(out / "report.html", page)
            if told.intervals is not None:
                write_json(out / "intervals.json", told.intervals.model_dump(mode="json"))
        if told.intervals is None:  # the old intervals belong to an earlier fit
            (out / "intervals.json").unlink(missing_ok=True)


def _write_changed(path: Path, content: bytes) -> None:
    """Write a file, unless it already has the same contents."""
    if not path.is_file() or path.read_bytes() != content:
        write_bytes(path, content)
