"""The `diffcloud` command."""

from __future__ import annotations

import io
import os
import shlex
import stat
import sys
import tempfile
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from diffcloud import __version__
from diffcloud.cli.group import command_group
from diffcloud.console import errors, say
from diffcloud.errors import DiffCloudError
from diffcloud.io.files import refuse_undecoded
from diffcloud.jobs import ctrl_c
from diffcloud.jobs.fork_server import begin_importing
from diffcloud.jobs.memory import keep_freed_memory

_PARALLEL = {
    "data preprocess": "diffcloud.jobs.preprocess",
    "network train": "diffcloud.jobs.train",
}
"""Commands that run their jobs in several processes, and what those import."""
_MOST_TOLD = 300
"""Characters of an unforeseen error's message."""
COMMANDS = {
    "fit": "diffcloud.cli.fit:fit",
    "simulate": "diffcloud.cli.simulate:simulate",
    "view": "diffcloud.cli.view:view",
    "export": "diffcloud.cli.export:export",
    "data": "diffcloud.cli.data:app",
    "network": "diffcloud.cli.network:app",
    "doctor": "diffcloud.cli.doctor:doctor",
}
"""Name -> where it lies; it is imported when it is run or asked for help."""

app = typer.Typer(
    cls=command_group(COMMANDS),
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Find the simulator parameters of a real cloth from the point clouds of its motion.",
)


@app.callback()
def diffcloud(
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an unexpected error.")] = False,
) -> None:
    """Find the simulator parameters of a real cloth from the point clouds of its motion."""
    del debug  # `main` looks for it in the command line, which it must know if this is not reached


def main() -> None:
    """`diffcloud`."""
    run(app, _PARALLEL.get(" ".join(sys.argv[1:3])))


def stage(command: Callable[..., None], preload: str | None = None) -> None:
    """A stage of the pipeline as a program.

    Args:
        preload: module that worker processes need; see `run`.
    """
    alone = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    alone.command()(command)
    run(alone, preload)


def run(app: typer.Typer, preload: str | None = None) -> None:
    """Run a command-line app. Turn an error into a message and exit status 1.

    The message of a `DiffCloudError` is its own text. For any other error, the message names the file with the
    traceback; with --debug, `run` raises that error instead.

    Args:
        preload: module that worker processes import while the command still reads its arguments.
    """
    _have_a_home()
    keep_freed_memory()
    ctrl_c.listen()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal or a log may know fewer letters than messages have
            stream.reconfigure(errors="backslashreplace")
    try:
        refuse_undecoded(sys.argv[1:])
        if preload is not None:
            begin_importing(preload, sys.argv[1:])
        with ctrl_c.none_lost():
            app()
    except DiffCloudError as error:
        say("Error:", str(error), style="bold red")
        sys.exit(1)
    except SystemExit as ended:
        # typer ends a command at a Ctrl-C without a word; what ends with this status by itself has said why
        if isinstance(getattr(ended.__context__, "__cause__", None), KeyboardInterrupt):
            errors.print("Interrupted.")
        raise
    except KeyboardInterrupt as pressed:
        if pressed.__cause__ is not None and "--debug" in sys.argv[1:2]:
            raise
        errors.print("Interrupted.")
        sys.exit(130)
    except Exception as error:
        if "--debug" in sys.argv[1:2]:
            raise
        say("Error:", _unforeseen(error), style="bold red")
        sys.exit(1)


def _have_a_home() -> None:
    """Name a folder of this user's alone as home where the system knows none, as for a container's user without an entry in
    passwd: the cameras' library fails without a home, and caches would go to a folder ~ in the current one."""
    if os.environ.get("HOME") or os.path.expanduser("~") not in ("~", ""):
        return
    folder = Path(tempfile.gettempdir()) / f"diffcloud-home-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
            folder = Path(tempfile.mkdtemp(prefix="diffcloud-home-"))  # somebody else made it
    except OSError:
        folder = Path(tempfile.gettempdir())
    os.environ["HOME"] = str(folder)


def _unforeseen(error: Exception) -> str:
    """What to say of an error that is a fault of the program; its traceback is kept."""
    told = " ".join(f"{type(error).__name__}: {error}".split())[:_MOST_TOLD]
    if isinstance(error, MemoryError):
        told = f"Out of memory ({told}). Try fewer or smaller episodes, frames, nodes or points"
    else:
        told = f"Unexpected error ({told})"
    head = f"diffcloud {__version__}, Python {sys.version.split()[0]}"
    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix="diffcloud-", suffix=".log", delete=False, encoding="utf-8", errors="backslashreplace"
        ) as log:
            log.write("\n".join([head, shlex.join(sys.argv), *traceback.format_exception(error)]))
        kept = f"The traceback is in {log.name}; please attach that file to a report"
    except OSError:
        kept = "Put --debug right after `diffcloud` to see the traceback, and please report it"
    return f"{told}. {kept}."


if __name__ == "__main__":
    main()
