"""Terminal output (progress and messages on standard error, results on standard output), and parsing of options."""

from __future__ import annotations

import inspect
import json
import re
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

from rich.console import Console
from rich.panel import Panel
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

from diffcloud.errors import ConfigError
from diffcloud.io.files import claimed, files_in

if TYPE_CHECKING:
    from diffcloud.hardware.installed import Check

_QUIET_S = 10.0
"""Interval between progress lines if standard error is not a terminal."""
_LONGEST_S = 3.6e6
_PLAIN_WIDTH = 140
"""Line width [characters] of output to a file or log. It is wide enough for all table headings."""


def _console(*, stderr: bool) -> Console:
    # Markup is off, because file names and messages may contain brackets. Styled output uses Text.
    console = Console(stderr=stderr, highlight=False, markup=False)
    if not console.is_terminal:
        console.width = _PLAIN_WIDTH
    return console


errors = _console(stderr=True)
output = _console(stderr=False)

Item = TypeVar("Item")
Command = TypeVar("Command", bound=Callable[..., Any])


def finish(result: dict[str, Any], as_json: bool) -> None:
    """Print the result as JSON, if requested."""
    if as_json:
        sys.stdout.write(json.dumps(result, allow_nan=False) + "\n")
        sys.stdout.flush()


def show_panel(title: str, rows: Sequence[tuple[str, str | Table]], *, style: str) -> None:
    """Print one panel on standard error: a name on the left of each row, its text or table on the right."""
    grid = Table.grid(padding=(0, 2))
    for name, content in ((name, content) for name, content in rows if content):
        grid.add_row(Text(name, "bold"), content)
    errors.print(Panel(grid, title=Text(title, f"bold {style}"), title_align="left", border_style=style, expand=False))


def known(number: float | None, form: str) -> str:
    """Format a number that may be missing for a table cell."""
    return "–" if number is None else format(number, form)


def show(table: Table, as_json: bool) -> None:
    """Print a table. With --json, use standard error, so that standard output has only JSON."""
    (errors if as_json else output).print(table)


def show_checks(checks: Sequence[Check], as_json: bool) -> None:
    """Print the checks of an installation or of a conformance test. See `show`."""
    table = Table("", "state", "detail")
    for check in checks:
        table.add_row(check.name, Text(check.state, "green" if check.state == "ok" else "red"), check.detail)
    show(table, as_json)


def warn(message: str) -> None:
    say("Warning:", message, style="yellow")


def say(head: str, message: str, *, style: str, console: Console | None = None) -> None:
    """Print a line with a styled beginning, by default on standard error."""
    (console or errors).print(Text.assemble((head, style), " ", message), soft_wrap=True)


@contextmanager
def progress_bar(label: str, total: int | None, budget_s: float | None = None) -> Iterator[Callable[[float, str], None]]:
    """Show a progress bar on standard error. Yields a function to call with (done, text).

    Without a terminal, a line is printed every ten seconds.

    Args:
        total: total amount of work. None: unknown, so the bar shows the elapsed part of `budget_s`.
        budget_s: time limit of the work [s], shown beside the elapsed time.
    """
    limit = "" if budget_s is None else f" of {budget_s:.0f} s"
    columns: tuple[ProgressColumn, ...] = (
        TextColumn("{task.description}", style="bold", markup=False),
        BarColumn(bar_width=24),
        *((MofNCompleteColumn(), TimeRemainingColumn()) if total is not None else ()),
        TimeElapsedColumn(),
        TextColumn(limit.strip(), markup=False),
        TextColumn("{task.fields[text]}", markup=False),
    )
    with Progress(*columns, console=errors, transient=True, disable=not errors.is_terminal) as progress:
        task = progress.add_task(label, total=budget_s if total is None else total, text="")
        began = told = time.monotonic()

        def update(done: float, text: str = "") -> None:
            nonlocal told
            now = time.monotonic()
            progress.update(task, completed=done if total is not None else now - began, text=text)
            if progress.disable and now - told >= _QUIET_S:
                told = now
                so_far = f"{now - began:.0f}{limit or ' s'}"
                if total is not None:
                    left = f", about {(now - began) * (total - done) / done:.0f} s left" if 0 < done < total else ""
                    so_far = f"{done:.4g} of {total}, {so_far}{left}"
                errors.print(f"{label}: {so_far}  {text}", soft_wrap=True)

        yield update


def told_progress(label: str, items: Sequence[Item]) -> Iterator[Item]:
    """Yield the items and show a progress bar with the number of finished ones."""
    with progress_bar(label, len(items)) as update:
        for done, item in enumerate(items):
            update(done, "")
            yield item


def refuse_many(items: Sequence[object], most: int, what: str, advice: str) -> None:
    """Check the number of episodes.

    Raises:
        ConfigError: there are more episodes than a command accepts.
    """
    if len(items) > most:
        raise ConfigError(f"{len(items)} episodes are given. {what} {most} at most. {advice}.")


def writes(suffix: str | None = None) -> Callable[[Command], Command]:
    """Decorate a command with an option `--out`, so that no other process writes to the output while it runs.

    Args:
        suffix: suffix of the output file. None: the output is a folder.
    """

    def decorate(command: Command) -> Command:
        signature = inspect.signature(command)

        @wraps(command)
        def held(*args: Any, **options: Any) -> Any:
            given = signature.bind(*args, **options)
            given.apply_defaults()
            out = given.arguments["out"]
            if out is None:
                return command(*args, **options)
            if suffix is not None:
                given.arguments["out"] = out = with_suffix(out, suffix)
            with claimed(out):
                return command(*given.args, **given.kwargs)

        return cast(Command, held)

    return decorate


def with_suffix(path: Path, suffix: str, option: str = "--out") -> Path:
    """Return the path of an output file with its suffix. A missing suffix is added, with a warning.

    Raises:
        ConfigError: the path has another suffix, or is a folder.
    """
    if path.suffix == suffix and not path.is_dir():
        return path
    if path.suffix or path.is_dir():
        kind = "is a folder" if path.is_dir() else f"ends in {path.suffix}"
        other = path / f"{path.resolve().name}{suffix}" if path.is_dir() else path.with_suffix(suffix)
        raise ConfigError(f"{option} takes a {suffix} file, and {path} {kind}. Try {other}.")
    warn(f"{option} takes a {suffix} file: writing to {path}{suffix}.")
    return path.with_name(path.name + suffix)


def assignments(items: list[str] | None, option: str) -> dict[str, float]:
    """Parse ["stretching=40", ...] to {"stretching": 40.0}."""
    values: dict[str, float] = {}
    for item in items or []:
        name, _, text = item.partition("=")
        try:
            values[name.strip()] = float(text)
        except ValueError as error:
            raise ConfigError(f"{option} takes NAME=NUMBER, got {item!r}.") from error
    return values


def duration_s(text: str, option: str) -> float:
    """Convert a duration ("90", "60s", "3min" or "1h") to seconds.

    Raises:
        ConfigError: the text has another form, or the duration is not positive.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?)\s*(s|min|h|)\s*", text)
    seconds = float(match[1]) * {"": 1, "s": 1, "min": 60, "h": 3600}[match[2]] if match else 0.0
    if not 0 < seconds <= _LONGEST_S:
        raise ConfigError(
            f"{option} takes a time above 0 and up to 1000 h, in seconds or with a unit (90, 60s, 3min, 1h), got {text!r}. "
            f"Try {option} 10min."
        )
    return seconds


def episode_files(paths: list[Path]) -> list[Path]:
    """Return episode files. A folder stands for all its `.npz` files, sorted.

    Raises:
        ConfigError: a folder has no episodes, or two episodes have the same name.
    """
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            inside = files_in(path, ".npz")
            if not inside:
                raise ConfigError(f"{path} holds no episodes (*.npz).")
            files += inside
        else:
            files.append(path)
    names = [path.stem for path in files]
    doubled = sorted({name for name in names if names.count(name) > 1})
    if doubled:
        raise ConfigError(f"Two episodes have the same name ({', '.join(doubled)}); results are stored by name.")
    return files
