"""Generated pages: one for each command, from the commands themselves, and one for the settings in params.yaml and
rig.yaml.

They are made when the site is built and not kept, so they cannot be out of date.
"""

from __future__ import annotations

import ast
import html
import inspect
import json
import re
import textwrap
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import typer

from diffcloud.cli.app import app
from diffcloud.estimation.settings import SOLVER_KINDS
from diffcloud.hardware.rig import RigSettings
from diffcloud.jobs import settings
from diffcloud.regressors.settings import TrainingSettings
from diffcloud.sensing.fusion import FusionSettings

ROOT = Path(__file__).parents[2]
SOLVERS = tuple(dict.fromkeys(SOLVER_KINDS.values()))
"""Kinds of the block `fit.solver`."""
STATUS = {
    0: "done",
    1: "an error, said in one line that begins with `Error:`",
    2: "options or arguments that the command does not have, or that do not convert",
    130: "Ctrl-C",
}
_SECTIONS = {
    ("fit",): "fit",
    ("view",): "preprocess",
    ("data", "preprocess"): "preprocess",
    ("network", "generate"): "generate",
    ("network", "train"): "train",
}
"""Command with --params -> the section that it reads."""
_FACTS = re.compile(r"\s*\[((?:default|required|x|\d)[^\]]*)\]$")


@cache
def commands() -> dict[tuple[str, ...], Any]:
    """Words of the command line -> its command, groups before their members: ("data",), ("data", "import"), ..."""
    found: dict[tuple[str, ...], Any] = {}

    def walk(command: Any, path: tuple[str, ...]) -> None:
        if path:
            found[path] = command
        for name, member in members(command).items():
            walk(member, (*path, name))

    walk(typer.main.get_command(app), ())
    return found


def members(command: Any) -> dict[str, Any]:
    """Commands of a group, which imports them when it is asked; none of a command."""
    if not hasattr(command, "list_commands"):
        return {}
    return {name: command.get_command(None, name) for name in command.list_commands(None)}


def command_of(text: str) -> tuple[str, ...] | None:
    """The command that a text such as `diffcloud data check FOLDER` is of."""
    words = text.split()
    if words[:1] != ["diffcloud"]:
        return None
    known = commands()
    return next((tuple(words[1:end]) for end in (3, 2) if tuple(words[1:end]) in known and len(words) >= end), None)


def address(path: tuple[str, ...]) -> str:
    """Of a command's page, in the site's source."""
    return f"commands/{'-'.join(path)}.md"


def command_pages(guides: Mapping[str, str]) -> dict[str, str]:
    """Address -> Markdown of all commands' pages.

    Args:
        guides: address -> Markdown of the hand-written pages; a command's page links to those that show it.
    """
    shown: dict[tuple[str, ...], list[str]] = {}
    for source, text in guides.items():
        for match in re.finditer(r"\bdiffcloud\s+[a-z]+(?:\s+[a-z]+)?", text):
            path = command_of(match[0])
            if path is not None and source not in shown.setdefault(path, []):
                shown[path].append(source)
    titles = {source: "Home" if source == "index.md" else title(text) for source, text in guides.items()}
    pages = {}
    rows = []
    for path, command in commands().items():
        links = [f"[{titles[source]}](../{source})" for source in shown.get(path, ())]
        pages[address(path)] = _command_page(path, command, links)
        rows.append(f"| [`diffcloud {' '.join(path)}`]({address(path).removeprefix('commands/')}) | {_summary(command)} |")
    statuses = "\n".join(f"| {status} | {meaning} |" for status, meaning in STATUS.items())
    pages["commands/index.md"] = (
        "# Commands\n\n| | |\n|---|---|\n" + "\n".join(rows) + "\n\n"
        "All take `--help`, and `--json`: the last line of standard output is then one JSON object. Progress, tables and\n"
        "messages then go to standard error. `--params` names a file of [settings](settings.md).\n\n"
        f"## Exit status\n\n| | |\n|---|---|\n{statuses}\n"
    )
    pages["commands/settings.md"] = settings_page()
    return pages


def navigation() -> list[dict[str, str] | str]:
    """Entries of the site's section of commands."""
    own: list[dict[str, str] | str] = ["commands/index.md", {"Settings": "commands/settings.md"}]
    return own + [{" ".join(path): address(path)} for path in sorted(commands())]


def title(text: str) -> str:
    """Of a page, from its Markdown."""
    return next(line.removeprefix("# ") for line in text.splitlines() if line.startswith("# "))


def _summary(command: Any) -> str:
    return _cell(_escaped(_flat(command.help or "").split(". ")[0].rstrip(".")))


def _command_page(path: tuple[str, ...], command: Any, guides: list[str]) -> str:
    name = f"diffcloud {' '.join(path)}"
    context = command.make_context(name, [], resilient_parsing=True)
    described = inspect.cleandoc(command.callback.__doc__ if command.callback else command.help or "")
    usage = context.get_usage().removeprefix("Usage: ")
    parts = [f"# {name}", _escaped(described), f"```text\n{usage}\n```"]
    if guides:
        parts.append(f"Shown in: {', '.join(guides)}.")
    if inside := members(command):
        rows = [
            f"| [`{name} {member}`]({'-'.join((*path, member))}.md) | {_summary(one)} |" for member, one in inside.items()
        ]
        parts.append("## Commands\n\n| | |\n|---|---|\n" + "\n".join(rows))
    for kind, heading in (("argument", "Arguments"), ("option", "Options")):
        rows = [_row(parameter, context) for parameter in command.params if parameter.param_type_name == kind]
        if rows:
            head = "| | | default |\n|---|---|---|"
            parts.append(f"## {heading}\n\n{head}\n" + "\n".join(rows))
    if any(parameter.name == "params" for parameter in command.params):
        section = _SECTIONS[path]
        parts.append(f"`--params`: settings are in the section [`{section}`](settings.md#{section}).")
    parts.append("## Exit status\n\n0, or as [for all commands](index.md#exit-status).")
    return "\n\n".join(parts) + "\n"


def _row(parameter: Any, context: Any) -> str:
    declared, text = parameter.get_help_record(context)
    repeats = " (repeatable)" if parameter.multiple else ""
    declared = re.sub(r"<list\[(\w+)\]>", lambda match: f"<{match[1].lower()}>", declared)
    facts: list[str] = []
    while match := _FACTS.search(text):
        facts = match[1].split("; ") + facts
        text = text[: match.start()]
    default = next((f"`{fact.removeprefix('default: ')}`" for fact in facts if fact.startswith("default: ")), "")
    default = default.replace(f"{ROOT}/", "")
    limits = [fact for fact in facts if not fact.startswith("default: ") and fact != "required"]
    if "required" in facts:
        default = "**required**"
    meaning = _flat(text) + (f" ({', '.join(limits)})" if limits else "")
    return f"| `{_cell(declared)}`{repeats} | {_cell(_escaped(meaning))} | {_cell(default)} |"


def _flat(text: str) -> str:
    return " ".join(text.split())


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _escaped(text: str) -> str:
    """Return plain text as Markdown that shows every character; text between backquotes stays as it is.

    Angle brackets become entities, because Markdown has no backslash escape for the opening one.
    """
    parts = text.split("`")
    return "`".join(part if index % 2 else _plain(part) for index, part in enumerate(parts))


def _plain(text: str) -> str:
    return re.sub(r"([*_\[\]])", r"\\\1", html.escape(text, quote=False))


def settings_page() -> str:
    """Markdown of all settings of params.yaml and rig.yaml."""
    parts = [
        "# Settings",
        "What `params.yaml`, and any file for `--params`, can hold. Unknown keys and bad values are errors. What is not "
        "given has the default here; options of a command win over the file.",
        "`scenes` lists those that the pipeline goes through: " + _value(settings.Config().scenes) + ".",
    ]
    for name, field in settings.Config.model_fields.items():
        section = field.default
        if isinstance(section, settings.Section):
            parts += [f"## {name}", _escaped(_flat(type(section).__doc__ or "")), _settings_table(section)]
            for key in type(section).model_fields:
                inner = getattr(section, key)
                if isinstance(inner, SOLVERS):
                    parts += _solver_tables()
                elif isinstance(inner, settings.Section):
                    parts += [f"## {name}.{key}", _escaped(_flat(type(inner).__doc__ or "")), _settings_table(inner)]
    rig = RigSettings()
    parts += ["## rig.yaml", _escaped(_flat(RigSettings.__doc__ or "")), _settings_table(rig)]
    parts += ["## rig.yaml: board", _escaped(_flat(type(rig.board).__doc__ or "")), _settings_table(rig.board)]
    return "\n\n".join(parts) + "\n"


def _solver_tables() -> list[str]:
    """`fit.solver` is one of several blocks, by its name."""
    parts = ["## fit.solver", "One of these blocks. A name alone, such as `solver: adam`, stands for its defaults."]
    for kind in SOLVERS:
        names = ", ".join(name for name, one in SOLVER_KINDS.items() if one is kind)
        parts += [f"### {names}", _escaped(_flat(kind.__doc__ or "")), _settings_table(kind())]
    return parts


def _settings_table(section: settings.Section) -> str:
    others = TrainingSettings if isinstance(section, settings.TrainSettings) else FusionSettings
    meanings = attribute_docs(others) | attribute_docs(type(section))
    rows = []
    for key in type(section).model_fields:
        value = getattr(section, key)
        if not isinstance(value, settings.Section):
            meaning = meanings.get(key) or _choices(type(section).model_fields[key].annotation)
            rows.append(f"| `{key}` | {_value(value)} | {_cell(_escaped(_flat(meaning)))} |")
    return "| | default | meaning |\n|---|---|---|\n" + "\n".join(rows)


def _choices(annotation: Any) -> str:
    """Names that a setting may have, where its type lists them."""
    if get_origin(annotation) is Literal:
        return f"One of {', '.join(f'`{name}`' for name in get_args(annotation))}." if len(get_args(annotation)) > 1 else ""
    return next(filter(None, map(_choices, get_args(annotation))), "")


def _value(value: Any) -> str:
    return f"`{json.dumps(value)}`"


def attribute_docs(described: type) -> dict[str, str]:
    """Attribute -> the string below it in a class's source."""
    body = ast.parse(textwrap.dedent(inspect.getsource(described))).body[0]
    assert isinstance(body, ast.ClassDef)
    found = {}
    for node, after in zip(body.body, body.body[1:], strict=False):
        if (
            isinstance(node, ast.AnnAssign)
            and isinstance(node.target, ast.Name)
            and isinstance(after, ast.Expr)
            and isinstance(after.value, ast.Constant)
        ):
            found[node.target.id] = str(after.value.value)
    return found
