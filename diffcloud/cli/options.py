"""Options that several commands share."""

from __future__ import annotations

import inspect
import types
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import typer
from pydantic import ValidationError
from pydantic.fields import FieldInfo

from diffcloud.errors import ConfigError
from diffcloud.settings import Section

ADVANCED = "Advanced options"
"""Heading of the second panel of the help."""

Topics = Annotated[
    list[str] | None,
    typer.Option(
        "--topic",
        help="ROS: topic to use, or TOPIC#NUMBER of one of its publishers; repeatable.",
    ),
]
JsonFlag = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
Threads = Annotated[
    int | None,
    typer.Option(
        min=1,
        max=1024,
        help="Threads of the simulation. Default: all cores.",
        rich_help_panel=ADVANCED,
    ),
]
Workers = Annotated[
    int | None,
    typer.Option(
        min=1,
        max=1024,
        help="Processes, each with one thread. Default: one per core.",
        rich_help_panel=ADVANCED,
    ),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        "--scheduler",
        help="Address of a Dask scheduler, such as tcp://host:8786, instead of --workers. It needs the same folders.",
        rich_help_panel=ADVANCED,
    ),
]
ParamsFile = Annotated[
    Path | None,
    typer.Option("--params", help="YAML file of settings. Options override it.", rich_help_panel=ADVANCED),
]
StageParams = Annotated[Path | None, typer.Option("--params", help="YAML with a section for each stage.")]
SCENE_HELP = (
    "YAML or ARCSim JSON file, or lift, fold, band_stretch, vest_hang, shake, hang, recorded_lift, recorded_fold, or "
    "release_lift=FILE.json (release_fold, release_hang, release_band)."
)
SceneName = Annotated[str | None, typer.Option("--scene", help=SCENE_HELP)]


def settings_options(
    kind: type[Section], *, everyday: Sequence[str], advanced: Sequence[str]
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Replace a command's argument `settings` by one option for each field; the command gets what was typed, by field.

    Args:
        kind: settings of a task.
        everyday: fields with an option in the first panel of the help.
        advanced: fields with an option in the second panel; of a block inside, as in "solver.max_steps". The others
            stand in --params only.
    """

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        own = inspect.signature(command, eval_str=True)
        fields = (*everyday, *advanced)
        found = {name: _field(kind, name) for name in fields}
        names = {name.rpartition(".")[2]: name for name in fields}

        @wraps(command)
        def run(**given: Any) -> Any:
            typed = {path: value for name, path in names.items() if (value := given.pop(name)) not in (None, [])}
            return command(**given, settings={path: _parsed(found[path], value, path) for path, value in typed.items()})

        added = [
            inspect.Parameter(
                name,
                inspect.Parameter.KEYWORD_ONLY,
                default=None,
                annotation=_option(name, found[path], None if path in everyday else ADVANCED),
            )
            for name, path in names.items()
        ]
        kept = [
            one.replace(kind=inspect.Parameter.KEYWORD_ONLY) for one in own.parameters.values() if one.name != "settings"
        ]
        vars(run)["__signature__"] = inspect.Signature([*kept, *added])
        run.__annotations__ = {one.name: one.annotation for one in (*kept, *added)}
        return run

    return decorate


def typed_options(context: typer.Context, but: Sequence[str]) -> list[str]:
    """Return the typed options as words of a command line, except the parameters named in `but`."""
    words = []
    for option in context.command.params:
        name = option.name or ""
        source = context.get_parameter_source(name)
        if name in but or source is None or source.name != "COMMANDLINE":
            continue
        value, flag = context.params[name], option.opts[0]
        if value is True:
            words.append(flag)
        else:
            words += [word for one in (value if isinstance(value, list | tuple) else [value]) for word in (flag, str(one))]
    return words


def merged(settings: Section, typed: Mapping[str, Any]) -> Any:
    """The settings with what was typed in place, field by field: a mapping or a block keeps what was not typed.

    Raises:
        ConfigError: a value that cannot be; names the option.
    """
    told, kind = settings.model_dump(), type(settings)
    for path, value in typed.items():
        outer, _, name = path.rpartition(".")
        block = told[outer] if outer else told
        if isinstance(block.get(name), dict) and isinstance(value, dict):
            block[name] = {**block[name], **value}
        elif isinstance(block.get(name), dict):
            block[name] = _another(kind.model_fields[name], block[name], value)
        else:
            block[name] = value
    try:
        return kind.model_validate(told)
    except ValidationError as error:
        faults = [_said(_flag_of(kind, fault["loc"], typed), fault) for fault in error.errors()]
        raise ConfigError("; ".join(faults) + ".") from error


def _said(flag: str, fault: Any) -> str:
    """Return an option, what is allowed, and what was found, of one fault of a validator."""
    if fault["type"] == "extra_forbidden":
        return f"{flag} does not apply to the chosen solver. Omit it, or choose another --solver"
    text = fault["msg"].removeprefix("Value error, ").replace("Input should be", "must be")
    found = fault["input"]
    got = f" (got {found!r})" if isinstance(found, str | int | float) and "got " not in text else ""
    return f"{flag}: {text}{got}" if flag else text.replace("bounds.", "--bound ") + got


def _another(field: FieldInfo, stored: Mapping[str, Any], name: str) -> dict[str, Any]:
    """The block of that name in place of another one, with what both know; what is lost is said."""
    from diffcloud.console import warn

    kinds = {one: block for block in _blocks(field) for one in get_args(block.model_fields["name"].annotation)}
    default, known = kinds[stored["name"]]().model_dump(), kinds[name].model_fields if name in kinds else {}
    said = {key: value for key, value in stored.items() if key != "name" and value != default[key]}
    if name in kinds and (lost := [key for key in said if key not in known]):
        warn(f"{name} has no {', '.join(lost)}, which --params states for {stored['name']}.")
    return {"name": name, **{key: value for key, value in said.items() if key in known}}


def _field(kind: type[Section], path: str) -> FieldInfo:
    """The field of a section, or of the first kind of block inside it that has it."""
    outer, _, name = path.rpartition(".")
    if not outer:
        return kind.model_fields[name]
    return next(block.model_fields[name] for block in _blocks(kind.model_fields[outer]) if name in block.model_fields)


def _blocks(field: FieldInfo) -> list[type[Section]]:
    """The kinds of block that a field takes."""

    def inside(part: Any) -> list[type[Section]]:
        if isinstance(part, type) and issubclass(part, Section):
            return [part]
        return [found for one in get_args(part) for found in inside(one)]

    return inside(field.annotation)


def _plain(annotation: Any) -> Any:
    """The type under None and notes."""
    if get_origin(annotation) is Annotated:
        return _plain(get_args(annotation)[0])
    if get_origin(annotation) in (types.UnionType, Union):
        return _plain(next(one for one in get_args(annotation) if one is not type(None)))
    return annotation


def _option(name: str, field: FieldInfo, panel: str | None) -> Any:
    plain, extra = _plain(field.annotation), field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}
    flag, text = str(extra.get("flag", f"--{name.replace('_', '-')}")), " ".join((field.description or "").split())
    if plain is bool:
        return Annotated[bool | None, typer.Option(flag, help=text, rich_help_panel=panel)]
    if get_origin(plain) is dict:
        return Annotated[list[str] | None, typer.Option(flag, help=text, metavar="NAME=VALUE", rich_help_panel=panel)]
    if get_origin(plain) is list:
        return Annotated[list[str] | None, typer.Option(flag, help=text, metavar="LIST", rich_help_panel=panel)]
    if plain in (int, float):
        return Annotated[plain | None, typer.Option(flag, help=text, rich_help_panel=panel)]
    choices = "|".join(get_args(plain)) if get_origin(plain) is Literal else "TEXT"
    return Annotated[str | None, typer.Option(flag, help=text, metavar=choices, rich_help_panel=panel)]


def _parsed(field: FieldInfo, value: Any, path: str) -> Any:
    """What was typed as it would stand in YAML."""
    kind = get_origin(_plain(field.annotation))
    if kind is list:
        return [part.strip() for item in value for part in item.split(",")]
    if kind is not dict:
        return value
    found = {}
    for item in value:
        name, equals, text = item.partition("=")
        if not (name and equals and text):
            raise ConfigError(f"{_flag(path, field)} takes NAME=VALUE, got {item!r}.")
        found[name.strip()] = text.split(":") if ":" in text else text
    return found


def _flag(path: str, field: FieldInfo) -> str:
    extra = field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}
    return str(extra.get("flag", f"--{path.rpartition('.')[2].replace('_', '-')}"))


def _flag_of(kind: type[Section], place: Sequence[int | str], typed: Mapping[str, Any]) -> str:
    """The option that a fault is about and the part of its value, or else the key in --params.

    Args:
        place: of the fault; pydantic names the kind of a block in it too, which no path has.
    """
    field = kind.model_fields.get(str(place[0])) if place else None
    skipped = 1 if field is not None and len(_blocks(field)) > 1 and len(place) > 2 else None
    path = ".".join(str(part) for index, part in enumerate(place) if index != skipped)
    option = max((one for one in typed if path == one or path.startswith(f"{one}.")), key=len, default=None)
    if option is None:
        return path
    return f"{_flag(option, _field(kind, option))} {path.removeprefix(option).removeprefix('.')}".strip()
