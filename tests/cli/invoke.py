"""Commands in this process, a second instead of several, where hardware can be put in their way; and as processes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from typer.testing import CliRunner

from diffcloud.cli.app import COMMANDS, app
from diffcloud.errors import DiffCloudError
from studies.__main__ import app as studies

DIFFCLOUD = [sys.executable, "-m", "diffcloud"]
ROOT = Path(__file__).parents[2]


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
    """Run with --json and check the exit status; `answer` is typed at prompts."""
    done = CliRunner().invoke(app if arguments[0] in COMMANDS else studies, [*map(str, arguments), "--json"], input=answer)
    errors, status = done.stderr, done.exit_code
    if isinstance(done.exception, DiffCloudError):  # as diffcloud.cli.app.run reports it
        errors, status = errors + str(done.exception), 1
    elif done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    assert status == code, f"status {status}\n{done.stdout}\n{errors}"
    lines = done.stdout.strip().splitlines()
    result = json.loads(lines[-1]) if lines and lines[-1].startswith("{") else {}
    return Invoked(result, " ".join(errors.split()))


def run_process(*arguments: object, cwd: Path) -> dict[str, Any]:
    """Run as a person does, with --json; the JSON object."""
    command = [*DIFFCLOUD, *map(str, arguments), "--json"]
    done = subprocess.run(command, cwd=cwd, env=environment(), capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, f"status {done.returncode}\n{done.stdout}\n{done.stderr}"
    return dict(json.loads(done.stdout.strip().splitlines()[-1]))
