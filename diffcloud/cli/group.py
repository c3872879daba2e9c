"""A group of commands, each of whose files is imported when it is run or asked for help.

Commands import torch and the simulator inside their functions, so that help and a mistyped option cost no seconds.
"""

from __future__ import annotations

import ast
import importlib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

_LONGEST = 20
"""Characters of a list of choices that the help shows as a type."""


def command_group(places: Mapping[str, str]) -> type[TyperGroup]:
    """A group of the commands that lie at places, "module:function" or "module:app" for a group of its own."""

    class CommandGroup(TyperGroup):
        """Finds a command by its name."""

        def list_commands(self, ctx: Any) -> list[str]:
            return list(places)

        def get_command(self, ctx: Any, cmd_name: str) -> Any:
            return _imported(cmd_name, places[cmd_name]) if cmd_name in places else None

        def format_help(self, ctx: Any, formatter: Any) -> None:
            """As usual; of each command the name and the first paragraph, which are read from its file."""
            self.get_command = lambda ctx, cmd_name: _summary(cmd_name, places[cmd_name])  # type: ignore[method-assign]
            try:
                super().format_help(ctx, formatter)
            finally:
                del self.get_command

    return CommandGroup


def _imported(name: str, place: str) -> Any:
    module, _, attribute = place.partition(":")
    found = getattr(importlib.import_module(module), attribute)
    if not isinstance(found, typer.Typer):
        alone = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
        alone.command(name)(found)
        found = alone
    command: Any = get_command(found)
    command.name = name
    for param in command.params:
        shown = param.display_type_rich
        vars(param)["display_type_rich"] = lambda ctx, shown=shown: _short_type(shown(ctx))
        vars(param)["_get_number_range_help_str"] = lambda: ""
    return command


def _short_type(text: str | None) -> str:
    """Shorten the type of a value in the help, so that the explanation has room: `<list[str]>` is TEXT."""
    kind = re.sub(r"<(?:list\[)?([\w|]+).*>", r"\1", text or "")
    if "|" in kind and len(kind) > _LONGEST:
        return "NAME"
    return {"bool": "", "str": "TEXT", "float": "NUMBER"}.get(kind, kind if "|" in kind else kind.upper())


def _summary(name: str, place: str) -> TyperCommand:
    """The command's name and help: the docstring of its function, or of a group's file."""
    module, _, attribute = place.partition(":")
    path = Path(__file__).parents[2].joinpath(*module.split(".")).with_suffix(".py")
    file = ast.parse(path.read_text(encoding="utf-8"))
    functions = (node for node in file.body if isinstance(node, ast.FunctionDef) and node.name == attribute)
    return TyperCommand(name, help=ast.get_docstring(next(functions, file)) or "")
