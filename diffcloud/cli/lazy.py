"""Commands whose modules are imported when they run, not to list them, to show their help or to refuse a mistyped option.

Commands that are groups of their own are imported for their help.
"""

from __future__ import annotations

import ast
import gc
import importlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command


def lazy_group(places: dict[str, str]) -> type[TyperGroup]:
    """A group of the commands that lie at places, "module:function" or "module:app" for a group of its own."""

    class LazyGroup(TyperGroup):
        """Finds a command by its name."""

        def list_commands(self, ctx: Any) -> list[str]:
            return list(places)

        def get_command(self, ctx: Any, cmd_name: str) -> Any:
            return _load(cmd_name, places[cmd_name]) if cmd_name in places else None

        @property
        def commands(self) -> Any:
            return _Commands(places)

        @commands.setter
        def commands(self, given: Any) -> None:
            """Those that were registered as usual: none."""

        def format_help(self, ctx: Any, formatter: Any) -> None:
            """As usual, but with names and first sentences alone for commands."""
            self.get_command = lambda ctx, cmd_name: _summary(cmd_name, places[cmd_name])  # type: ignore[method-assign]
            try:
                super().format_help(ctx, formatter)
            finally:
                del self.get_command

    return LazyGroup


class _Commands(Mapping[str, Any]):
    """Names, and the commands, each imported when it is asked for."""

    def __init__(self, places: dict[str, str]) -> None:
        self._places = places

    def __getitem__(self, name: str) -> Any:
        return _load(name, self._places[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)


def _load(name: str, place: str) -> Any:
    module, _, attribute = place.partition(":")
    found: typer.Typer | Callable[..., Any] = _signature(module, attribute) or _imported(module, attribute)
    if isinstance(found, typer.Typer):
        command = get_command(found)
    else:
        alone = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
        alone.command(name)(found)
        command = get_command(alone)
    command.name = name
    return command


def _imported(module: str, attribute: str) -> Any:
    with imports():
        return getattr(importlib.import_module(module), attribute)


@contextmanager
def imports() -> Iterator[None]:
    """What is imported here stays to the end, so no collector of garbage need go through it: neither meanwhile, nor later,
    nor at the end, which takes a third of the time that a command needs to start and to stop."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


def _parsed(module: str) -> list[ast.stmt]:
    path = Path(__file__).parents[2].joinpath(*module.split(".")).with_suffix(".py")
    return ast.parse(path.read_text(encoding="utf-8")).body


def _signature(module: str, attribute: str) -> Callable[..., Any] | None:
    """A command with its options and docstring that imports its file when it is called; None for a group.

    Of the file only the function's head is read, and those imports and constants that the head names: what it does may need
    libraries that take seconds to import.
    """
    statements = _parsed(module)
    command = next((one for one in statements if isinstance(one, ast.FunctionDef) and one.name == attribute), None)
    if command is None:
        return None
    wanted = _names(command.args)
    needed: list[ast.stmt] = []
    for statement in reversed(statements):  # what a constant is made of comes before it
        if isinstance(statement, ast.Import | ast.ImportFrom):
            statement.names = [one for one in statement.names if (one.asname or one.name) in wanted]
            if statement.names:
                needed.append(statement)
        elif isinstance(statement, ast.Assign) and any(_names(target) & wanted for target in statement.targets):
            needed.append(statement)
            wanted |= _names(statement.value)
    run = ast.parse("return _imported()(**locals())", mode="exec").body
    command.decorator_list, command.body = [], [*command.body[: ast.get_docstring(command) is not None], *run]
    future = ast.parse("from __future__ import annotations").body
    code = ast.fix_missing_locations(ast.Module([*future, *reversed(needed), command], type_ignores=[]))
    found: dict[str, Any] = {"_imported": lambda: _imported(module, attribute)}
    exec(compile(code, f"<options of {module}>", "exec"), found)  # of this package's own files
    return cast(Callable[..., Any], found[attribute])


def _names(node: ast.AST) -> set[str]:
    return {one.id for one in ast.walk(node) if isinstance(one, ast.Name)}


def _summary(name: str, place: str) -> TyperCommand:
    """The command's name and help, read from its file: the function's docstring, or `help` of a group."""
    module, _, attribute = place.partition(":")
    text = ""
    for node in _parsed(module):
        if isinstance(node, ast.FunctionDef) and node.name == attribute:
            text = ast.get_docstring(node) or ""
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and node.targets[0].id == attribute:
            options = node.value.keywords if isinstance(node.value, ast.Call) else []
            text = next((str(ast.literal_eval(option.value)) for option in options if option.arg == "help"), "")
        elif (
            isinstance(node, ast.ImportFrom)
            and node.module
            and attribute in [alias.asname or alias.name for alias in node.names]
        ):
            return _summary(name, f"{node.module}:{attribute}")
    return TyperCommand(name, help=text)
