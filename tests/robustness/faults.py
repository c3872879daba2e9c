"""Every command of the pipeline disturbed in the middle of its work: run again, it must end as if nothing had been."""

from __future__ import annotations

import csv
import ctypes
import io
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import psutil

from tests.cli.invoke import environment, program
from tests.robustness.inputs import SEED
from tests.robustness.kinds import REPORT, STAGES

Disturbance = Literal["kill", "Ctrl-C", "worker killed", "full disk", "read-only", "two at once"]
_USUAL: Mapping[Disturbance, int] = {"kill": 5, "Ctrl-C": 3, "full disk": 2, "read-only": 1, "two at once": 1}
_OF_WORKERS: Mapping[Disturbance, int] = {"worker killed": 5}
_OF_DVC: Mapping[Disturbance, int] = {"kill": 4, "Ctrl-C": 3, "two at once": 1}
"""Of a full or a read-only disk its own messages tell."""


@dataclass(frozen=True)
class Command:
    """What is disturbed."""

    line: tuple[str, ...]
    made: tuple[str, ...]
    """Folders that it fills."""
    counts: Mapping[Disturbance, int] = field(default_factory=lambda: _USUAL)
    """How often it meets each."""

    @staticmethod
    def of(arguments: str, *made: str, **options: Any) -> Command:
        return Command(tuple(program(*arguments.split())), made, **options)


COMMANDS = {
    **{name: Command.of(*stage) for name, stage in STAGES.items()},
    "report": Command.of(REPORT, "page"),
    "simulate a motion": Command.of("simulate small --format obj --out motion", "motion"),
    "export": Command.of("export data/fits/small/small_hidden1.json --to mujoco --out exported", "exported"),
    "fit one cloth": Command.of(
        "fit data/episodes/small/small_hidden1.npz --out known --parameters stretching --density 0.2 --threads 1", "known"
    ),
    "preprocess, two workers": Command.of(
        "data preprocess --params params.yaml --workers 2 --out twice/episodes twice/recorded",
        "twice/episodes",
        counts=_OF_WORKERS,
    ),
    "fit, two workers": Command.of(
        "pipeline.fit --params params.yaml --workers 2 --out twice/fits twice/given", "twice/fits", counts=_OF_WORKERS
    ),
    "dvc repro": Command((sys.executable, "-m", "dvc", "repro"), ("data/fits", "reports"), counts=_OF_DVC),
}
"""In the project of `kinds`."""
DISTURBANCES = get_args(Disturbance)
_TIMES = ("seconds", "date", "created", "fingerprint")
"""Fields of outputs that tell when, or how long, or are made of such."""
_TELL_TIMES = "seconds.csv"
"""A table that has nothing else."""
_PATIENCE = 300.0
_DAC_OVERRIDE, _DROP_BOUNDING = 1, 24


@dataclass(frozen=True)
class Fault:
    """One disturbed run."""

    command: str
    disturbance: Disturbance
    seed: int


def all_faults() -> list[Fault]:
    return [
        Fault(name, disturbance, seed)
        for name, command in COMMANDS.items()
        for disturbance, count in command.counts.items()
        for seed in range(count)
    ]


def survive(fault: Fault, project: Path, reference: dict[str, Any], usual_s: float) -> tuple[str | None, str]:
    """Disturb a run of a command, then run it again: what is wrong with what became of it, and what it printed.

    Args:
        project: with the outputs of all stages.
        reference: `contents` of what the command makes undisturbed.
        usual_s: how long that takes.
    """
    command = COMMANDS[fault.command]
    with _without_output(command, project) as work:
        told, status = _disturbed(fault, work, usual_s)
        wrong = None
        if status is None:
            wrong = "hang"
        elif "Traceback" in told or "Unexpected error" in told:
            wrong = "traceback"
        elif (
            status == 0 and fault.disturbance in ("full disk", "read-only") and _differs(contents(work, command), reference)
        ):
            wrong = "ended well, without all outputs"
        else:
            wrong = _half_written(contents(work, command), reference)
        if wrong is None:
            again = _run(command, work)
            if again.returncode != 0:
                wrong = f"cannot be run again: {again.stderr[-300:]}"
            elif differs := _differs(contents(work, command), reference):
                wrong = f"another result: {differs}"
            elif left := [name for name in _hidden(work, command) if not name.endswith(_MEANT)]:
                wrong = f"left over: {left}"
        return wrong, told[-400:]


_MEANT = (".diffcloud-lock", ".gitignore", ".timings.json")
"""Endings of hidden files that belong there."""


def _hidden(work: Path, command: Command) -> list[str]:
    return [path.name for made in command.made for path in (work / made).rglob(".*")]


def undisturbed(command: Command, project: Path) -> tuple[dict[str, Any], float]:
    """What a command makes, and how long it takes."""
    with _without_output(command, project) as work:
        began = time.monotonic()
        _run(command, work).check_returncode()
        return contents(work, command), time.monotonic() - began


@contextmanager
def _without_output(command: Command, project: Path) -> Iterator[Path]:
    """A copy of a project that lacks what the command makes."""
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder) / "project"
        shutil.copytree(project, work)
        for made in command.made:
            shutil.rmtree(work / made, ignore_errors=True)
        yield work


def _run(command: Command, work: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command.line, **_in(work), timeout=_PATIENCE, check=False)


def _in(work: Path) -> dict[str, Any]:
    return {"cwd": work, "env": environment(), "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}


def _disturbed(fault: Fault, work: Path, usual_s: float) -> tuple[str, int | None]:
    """What a run printed, and its exit status."""
    line, made = COMMANDS[fault.command].line, COMMANDS[fault.command].made[0]
    draw = random.Random(f"{fault.command} {fault.disturbance} {fault.seed}")
    prepare: Callable[[], None] | None = None
    moment: float | None = None
    signalled = signal.SIGKILL
    match fault.disturbance:
        case "kill" | "Ctrl-C" | "worker killed":
            moment = draw.uniform(0.1, 1.0) * usual_s
            signalled = signal.SIGINT if fault.disturbance == "Ctrl-C" else signal.SIGKILL
        case "full disk":
            limit = int(10 ** draw.uniform(2.0, 4.0))

            def prepare() -> None:
                signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
                resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

        case "read-only":
            (work / made).mkdir(parents=True)
            (work / made).chmod(0o555)
            prepare = _no_override
    one = subprocess.Popen(line, **_in(work), start_new_session=True, preexec_fn=prepare)
    other = None
    if fault.disturbance == "two at once":
        time.sleep(draw.uniform(0.0, 0.5) * usual_s)
        other = subprocess.Popen(line, **_in(work), start_new_session=True)
    if moment is not None:
        with suppress(subprocess.TimeoutExpired):
            one.wait(moment)
        if one.poll() is None:
            # Ctrl-C reaches all processes of a terminal, a kill by the system one of them
            if signalled == signal.SIGINT:
                os.killpg(one.pid, signalled)
            else:
                victims = _workers(one.pid) if fault.disturbance == "worker killed" else []
                (draw.choice(victims) if victims else one).send_signal(signalled)
    try:
        told = "".join(one.communicate(timeout=_PATIENCE))
        if other is not None:
            told += "".join(other.communicate(timeout=_PATIENCE))
    except subprocess.TimeoutExpired:
        os.killpg(one.pid, signal.SIGKILL)
        return "", None
    finally:
        with suppress(ProcessLookupError):
            os.killpg(one.pid, signal.SIGKILL)  # workers whose parent was killed
        if fault.disturbance == "read-only":
            (work / made).chmod(0o755)
    return told, one.returncode


def _workers(pid: int) -> list[psutil.Process]:
    """Children of a process that are computing or waiting for work."""
    return [child for child in psutil.Process(pid).children() if any("spawn_main" in word for word in child.cmdline())]


def _no_override() -> None:
    """For the superuser, too, a folder that is read-only is so."""
    if os.geteuid() == 0:
        ctypes.CDLL(None).prctl(_DROP_BOUNDING, _DAC_OVERRIDE, 0, 0, 0)


def contents(work: Path, command: Command) -> dict[str, Any]:
    """File -> what is in it, without what tells how long it took, and without what is hidden."""
    found: dict[str, Any] = {}
    for path in sorted(path for made in command.made for path in (work / made).rglob("*")):
        name = path.relative_to(work)
        if path.is_file() and not any(part.startswith(".") for part in name.parts) and not name.name.endswith(_TELL_TIMES):
            found[name.as_posix()] = _timeless(path)
    return found


def _timeless(path: Path) -> Any:
    data = path.read_bytes()
    with suppress(ValueError, UnicodeDecodeError, csv.Error):
        if path.suffix == ".json":
            return _without_times(json.loads(data))
        if path.suffix == ".csv":
            rows = csv.DictReader(io.StringIO(data.decode()))
            return [{key: value for key, value in row.items() if key not in _TIMES} for row in rows]
    return data


def _without_times(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_times(one) for key, one in value.items() if key not in _TIMES}
    return [_without_times(one) for one in value] if isinstance(value, list) else value


def _differs(found: dict[str, Any], reference: dict[str, Any]) -> str:
    """Files that differ; empty where none does."""
    return ", ".join(sorted(name for name in found.keys() | reference.keys() if found.get(name) != reference.get(name)))


def _half_written(found: dict[str, Any], reference: dict[str, Any]) -> str | None:
    """What lies there under its name before its time: it must be as the undisturbed run makes it. Lists of what is done
    grow, a command's own log may be shorter, and a fit that Ctrl-C ended is the best so far, and says so."""
    growing = ("manifest.json", "episode.json", "timestamps.csv", "robot.csv", ".tsv", "metrics.json")
    ended = {
        name.removesuffix(".json")
        for name, value in found.items()
        if isinstance(value, dict) and value.get("stop_reason") == "interrupted"
    }
    damaged = [
        name for name, value in found.items()
        if value != reference.get(name) and not name.endswith(growing) and name.rpartition(".")[0] not in ended
    ]  # fmt: skip
    return f"half-written: {', '.join(damaged)}" if damaged else None


def all_of_command(name: str, project: Path, sample: int | None = None) -> list[dict[str, Any]]:
    """Faults of one command: plain values, one mapping each."""
    faults = [fault for fault in all_faults() if fault.command == name]
    if sample is not None and sample < len(faults):
        faults = random.Random(f"{SEED} {name}").sample(faults, sample)
    reference, usual_s = undisturbed(COMMANDS[name], project)
    results = []
    for fault in faults:
        wrong, told = survive(fault, project, reference, usual_s)
        verdict = "survived" if wrong is None else "not survived"
        results.append({
            "suite": "faults", "of": name, "where": f"seed {fault.seed}", "what": fault.disturbance, "wrong": wrong,
            "verdict": verdict, "told": told,
        })  # fmt: skip
    return results
