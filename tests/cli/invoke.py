"""Commands in this process, a second instead of several, where hardware can be put in their way; and as processes."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import typer
from typer.main import get_command
from typer.testing import CliRunner

from diffcloud.cli.app import app
from diffcloud.cli.app import main as diffcloud_main
from diffcloud.cli.app import stage as run_stage
from diffcloud.errors import DiffCloudError
from studies.__main__ import app as studies

_COMMANDS = {"simulate": "generate"}
"""Stage -> name of its function, where they differ."""
DIFFCLOUD = [sys.executable, "-m", "diffcloud"]
ROOT = Path(__file__).parents[2]
T = TypeVar("T")


def wait_for(seen: Callable[[], T], process: subprocess.Popen[Any]) -> T:
    """Return the first true value of `seen`. A process may need minutes to start on a busy machine.

    Raises:
        AssertionError: the process ended before, or nothing was seen for five minutes.
    """
    deadline = time.monotonic() + 300
    while True:
        ended = process.poll()
        if found := seen():
            return found
        assert ended is None, f"ended with {ended} before it was seen"
        assert time.monotonic() < deadline, "nothing seen in five minutes"
        time.sleep(0.005)


def environment() -> dict[str, str]:
    """Of a process that runs this tree's commands, or whose children do by name."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    return {**os.environ, "PATH": path, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}


@dataclass(frozen=True)
class Invoked:
    """What a command printed."""

    result: dict[str, Any]
    """The JSON object, empty if there is none."""
    errors: str
    """Standard error, and the message of the project's own error, in one line."""


def invoke(*arguments: object, code: int = 0, answer: str | None = None) -> Invoked:
    """Run a command, or a stage as pipeline.NAME, with --json and check the exit status; `answer` is typed at prompts."""
    if str(arguments[0]).startswith("pipeline."):
        return stage(str(arguments[0]).removeprefix("pipeline."), *arguments[1:], code=code)
    return _invoked(app, arguments, code, answer)


def stage(name: str, *arguments: object, code: int = 0) -> Invoked:
    """The same for a stage of the pipeline."""
    return _invoked(_alone(f"pipeline.{name}"), arguments, code)


def stage_command(module: str) -> Any:
    """The command of pipeline.NAME, to parse a line with."""
    return get_command(_alone(module))


def _alone(module: str) -> typer.Typer:
    name = module.removeprefix("pipeline.")
    alone = typer.Typer(pretty_exceptions_enable=False)
    alone.command()(getattr(importlib.import_module(module), _COMMANDS.get(name, name)))
    return alone


def study(*arguments: object, code: int = 0) -> Invoked:
    """The same for a study."""
    return _invoked(studies, arguments, code)


def _invoked(chosen: typer.Typer, arguments: tuple[object, ...], code: int, answer: str | None = None) -> Invoked:
    done = CliRunner().invoke(chosen, [*map(str, arguments), "--json"], input=answer)
    errors, status = done.stderr, done.exit_code
    if isinstance(done.exception, DiffCloudError):  # as diffcloud.cli.app.run reports it
        errors, status = errors + str(done.exception), 1
    elif done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    assert status == code, f"status {status}\n{done.stdout}\n{errors}"
    lines = done.stdout.strip().splitlines()
    result = json.loads(lines[-1]) if lines and lines[-1].startswith("{") else {}
    return Invoked(result, " ".join(errors.split()))


def program(*arguments: object) -> list[str]:
    """The command line of a command, or of a stage as pipeline.NAME."""
    head = [sys.executable, "-m"] if str(arguments[0]).startswith("pipeline.") else DIFFCLOUD
    return [*head, *map(str, arguments)]


def main() -> None:
    """What `program` runs, in this process, by the arguments of the command line."""
    name = sys.argv[1].removeprefix("pipeline.")
    if name == sys.argv[1]:
        diffcloud_main()
        return
    del sys.argv[1]
    run_stage(getattr(importlib.import_module(f"pipeline.{name}"), _COMMANDS.get(name, name)))


def run_process(*arguments: object, cwd: Path) -> dict[str, Any]:
    """Run as a person does, with --json; the JSON object."""
    command = [*program(*arguments), "--json"]
    done = subprocess.run(command, cwd=cwd, env=environment(), capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, f"status {done.returncode}\n{done.stdout}\n{done.stderr}"
    return dict(json.loads(done.stdout.strip().splitlines()[-1]))
