"""The `diffcloud` command."""

from __future__ import annotations

import io
import os
import shlex
import stat
import sys
import tempfile
import traceback
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Annotated

import typer

from diffcloud import __version__
from diffcloud.cli import ctrl_c
from diffcloud.cli.console import errors, say
from diffcloud.cli.fork_server import begin_importing
from diffcloud.cli.lazy import lazy_group
from diffcloud.cli.memory import keep_freed_memory
from diffcloud.errors import DiffCloudError
from diffcloud.io.files import refuse_undecoded

_MOST_TOLD = 300
"""Characters of an unforeseen error's message."""
COMMANDS = {
    "import": "diffcloud.cli.importing:import_",
    "evaluate": "diffcloud.cli.evaluate:app",
    "episode": "diffcloud.cli.raw_episode:app",
    "episodes": "diffcloud.cli.episodes:episodes",
    "preprocess": "diffcloud.cli.preprocess:preprocess",
    "simulate": "diffcloud.cli.simulate:simulate",
    "fit": "diffcloud.cli.fit:fit",
    "train": "diffcloud.cli.train:train",
    "predict": "diffcloud.cli.predict:predict",
    "report": "diffcloud.cli.report:report",
    "identify": "diffcloud.cli.identify:identify",
    "init": "diffcloud.cli.init:init",
    "export": "diffcloud.cli.export:export",
    "view": "diffcloud.cli.view:view",
    "rollout": "diffcloud.cli.rollout:rollout",
    "visibility": "diffcloud.cli.visibility:visibility",
    "materials": "diffcloud.cli.materials:materials",
    "capture": "diffcloud.cli.capture:record",
    "calibrate": "diffcloud.cli.calibrate:calibrate",
    "doctor": "diffcloud.cli.doctor:doctor",
}
"""Name -> where it lies; it is imported when it is run."""
_PARALLEL = ("episodes", "preprocess", "fit", "train", "evaluate")
"""Commands that run their jobs through `diffcloud.cli.workers`."""

app = typer.Typer(
    cls=lazy_group(COMMANDS),
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
    run(app, COMMANDS, _PARALLEL)


def stage(name: str) -> None:
    """A stage of the pipeline as a program: the command of this name, with the options of the command line."""
    sys.argv[1:1] = [name]
    main()


def run(app: typer.Typer, places: Mapping[str, str], parallel: Collection[str]) -> None:
    """Run, and turn the project's own errors into a message and exit status 1; any other, into where its traceback is.

    Args:
        places: of its commands.
        parallel: commands that run their jobs through `diffcloud.cli.workers`.
    """
    _have_a_home()
    keep_freed_memory()
    ctrl_c.listen()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal or a log may know fewer letters than messages have
            stream.reconfigure(errors="backslashreplace")
    try:
        refuse_undecoded(sys.argv[1:])
        if sys.argv[1:2] and sys.argv[1] in parallel:
            begin_importing(places[sys.argv[1]].partition(":")[0], sys.argv[1:])
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
