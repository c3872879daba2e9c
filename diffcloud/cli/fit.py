"""`diffcloud fit`: from recordings of a cloth to its parameters."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from diffcloud.cli.options import (
    ADVANCED,
    JsonFlag,
    ParamsFile,
    SceneName,
    Threads,
    Topics,
    merged,
    settings_options,
    typed_options,
)
from diffcloud.console import duration_s, finish, show_panel
from diffcloud.errors import ConfigError
from diffcloud.estimation.settings import AdamSolver, FitSettings

if TYPE_CHECKING:
    from diffcloud.estimation.task import Recording
    from diffcloud.jobs.cloth_fit import ClothFit
    from diffcloud.reporting.page import Summary

_FITTING = 0.9
"""Part of the time of --budget after which fits end: the report needs some, too."""
_NOT_OF_PROJECT = ("recordings", "out", "size", "mesh", "topic", "separate", "dvc", "params", "json")
"""Parameters that are not copied to the params.yaml of a DVC project. Its files take their place."""


@settings_options(
    FitSettings,
    everyday=("parameters", "fixed", "level"),
    advanced=(
        "bounds",
        "prior",
        "solver",
        "solver.max_steps",
        "solver.starts",
        "loss",
        "alignment",
        "initial_state",
        "uncertain",
        "frames",
        "seed",
    ),
)
def fit(
    recordings: Annotated[
        list[Path],
        typer.Argument(
            help="Folders of clouds with a gripper.csv, episode files, raw episodes or ROS bags. SCENE=FILE states a scene."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for fit.json, intervals.json, report.html and the scene.")],
    settings: Mapping[str, Any],
    context: typer.Context,
    size: Annotated[str | None, typer.Option(help="Sides in m, such as 0.40x0.30. Default: from the first frame.")] = None,
    mesh: Annotated[Path | None, typer.Option(help="OBJ file of a cloth that is no rectangle, in metres.")] = None,
    density: Annotated[
        str | None, typer.Option(help="Mass per area in kg/m², such as 0.24 or 0.24+-0.01. Default: estimated.")
    ] = None,
    scene: SceneName = None,
    budget: Annotated[
        str,
        typer.Option(help="Time limit, such as 90, 60s, 3min, 1h, or none."),
    ] = "5min",
    topic: Topics = None,
    init: Annotated[
        str,
        typer.Option(
            help="First start: middle, PARAMETER=VALUE,..., mlp or another network, or a checkpoint.",
            rich_help_panel=ADVANCED,
        ),
    ] = "middle",
    separate: Annotated[bool, typer.Option("--separate", help="Fit each recording alone, in OUT/<recording>.")] = False,
    dvc: Annotated[bool, typer.Option("--dvc", help="Make a DVC project of OUT.")] = False,
    threads: Threads = None,
    params: ParamsFile = None,
    json: JsonFlag = False,
) -> None:
    """Estimate the parameters of a cloth from its recordings, with intervals and a report.

    Ctrl-C reports the best fit so far. The same command continues.
    """
    began = time.monotonic()
    from diffcloud.io.files import claimed
    from diffcloud.jobs.dvc_project import make_project
    from diffcloud.jobs.settings import load_config
    from diffcloud.reporting.fit_page import Status, result_of
    from diffcloud.sim.threads import use_threads

    use_threads(threads)
    seconds = None if budget == "none" else duration_s(budget, "--budget")
    weighed, sides = None if density is None else _weighed(density), None if size is None else _sides(size)
    if out.exists() and not out.is_dir():
        raise ConfigError(f"--out takes a folder, and {out} is a file.")
    stored = None if params is None else load_config(params).fit
    members = _members(recordings, scene)
    known = all(named is not None for _, named in members.values())
    if known and (size or density or mesh):
        raise ConfigError("--size, --mesh and --density are for a scene that is found; leave them out beside a known one.")
    if known and dvc:
        raise ConfigError("--dvc makes a project of a scene that is found; leave it out beside a known one.")
    results = {}
    interrupted = False
    with claimed(out):
        groups = {out / name: {name: one} for name, one in members.items()} if separate else {out: members}
        for folder, group in groups.items():
            if known:
                task = _known(group, folder, topic or (), settings, stored or FitSettings(), init)
            else:
                paths = [path for path, _ in group.values()]
                task = _found(paths, folder, sides, mesh, weighed, topic or (), settings, stored, init)
            left = None if seconds is None else max(_FITTING * seconds - (time.monotonic() - began), 1.0)
            told, summary = task.run(left)
            _show(summary, folder)
            results[folder.name] = result_of(told, summary)
            if told.status == Status.interrupted:
                interrupted = True
                break
            if dvc:
                make_project(folder, typed_options(context, _NOT_OF_PROJECT), params)
    finish(results if separate else next(iter(results.values())), json)
    if interrupted:
        raise KeyboardInterrupt


def _show(summary: Summary, folder: Path) -> None:
    """Print what a person reads first, as on the first screen of the report."""
    table = Table(*summary.parameters.heads, box=None, padding=(0, 2, 0, 0))
    for row in summary.parameters.rows:
        table.add_row(*(f"{cell.text} ({cell.note})" if cell.note else cell.text for cell in row))
    steps = "\n".join(f"{index}. {step}" for index, step in enumerate(summary.next_steps, 1))
    rows: list[tuple[str, str | Table]] = [
        ("Status", "\n".join([summary.residual, *summary.findings])),
        ("Parameters", table),
        ("Held out", summary.held_out),
        ("Next", steps),
        ("Files", f"{folder / 'report.html'}, {folder / 'fit.json'}"),
    ]
    style = {True: "green", False: "red", None: "yellow"}[summary.good]
    show_panel(summary.status, rows, style=style)


def _members(recordings: Sequence[Path], scene: str | None) -> dict[str, tuple[Path, str | None]]:
    """Name of each recording -> where it lies, and its scene; None: it is found.

    Raises:
        ConfigError: some name theirs and others do not, or two recordings have one name.
    """
    from diffcloud.jobs.scene_files import named_recordings

    parts = [(scene, path) for path in recordings]
    # an equals sign may be a part of a name
    if scene is None and not all(path.exists() for path in recordings) and any("=" in str(path) for path in recordings):
        pairs = [str(path).partition("=") for path in recordings]
        if not all(name and path for name, _, path in pairs):
            raise ConfigError("Give each recording its scene, as in lift=a.npz fold=b.npz, or none.")
        parts = [(name, Path(path)) for name, _, path in pairs]
    named = named_recordings([path for _, path in parts])
    own = {path: stated for stated, given in parts for path in named_recordings([given]).values()}
    return {name: (path, own[path]) for name, path in named.items()}


def _found(
    recordings: Sequence[Path],
    out: Path,
    size: tuple[float, float] | None,
    mesh: Path | None,
    weighed: tuple[float, float] | None,
    topics: Sequence[str],
    typed: Mapping[str, Any],
    stored: FitSettings | None,
    init: str,
) -> ClothFit:
    """The fit of recordings whose scenes are found, or read from what an earlier run found."""
    from diffcloud.estimation.task import Recording
    from diffcloud.identification import fit_settings, with_density
    from diffcloud.jobs.cloth_fit import ClothFit
    from diffcloud.jobs.scene_files import find_scene
    from diffcloud.scene.scenarios.catalogue import make_scenario, own_options

    episodes, cloth, layouts = find_scene(recordings, out, size, None if weighed is None else weighed[0], topics, mesh)
    if weighed is not None and weighed[1]:
        cloth = with_density(cloth, *weighed)
    scenes = {name: {**cloth, **fields} for name, fields in layouts.items()}
    members = [
        Recording(make_scenario(own_options(scenes[name], name, f"scene of {name}", folder=out)), name, episode)
        for name, episode in episodes.items()
    ]
    chosen = merged(fit_settings(typed.get("parameters"), members[0].scenario, weighed, stored), typed)
    return ClothFit(members, chosen, out, scenes, _start(init, members, chosen))


def _known(
    group: Mapping[str, tuple[Path, str | None]],
    out: Path,
    topics: Sequence[str],
    typed: Mapping[str, Any],
    stored: FitSettings,
    init: str,
) -> ClothFit:
    """The fit of recordings in known scenes."""
    from diffcloud.estimation.task import Recording
    from diffcloud.jobs.cloth_fit import ClothFit
    from diffcloud.jobs.scenarios import scene_named
    from diffcloud.jobs.scene_files import read_all, scene_fields

    sources = {name: str(stated) for name, (_, stated) in group.items()}
    chosen = stored
    if typed.get("loss") == "paper" and "solver" not in typed and chosen.solver.name == "likelihood":
        chosen = chosen.model_copy(update={"solver": AdamSolver()})  # that loss has no likelihood
    chosen = merged(chosen, typed)
    episodes = read_all({name: path for name, (path, _) in group.items()}, out, topics, keep=False)
    scenarios = {source: scene_named(source) for source in dict.fromkeys(sources.values())}
    members = [Recording(scenarios[sources[name]], name, episode) for name, episode in episodes.items()]
    found = {scenarios[source].name: fields for source in scenarios if (fields := scene_fields(source)) is not None}
    return ClothFit(members, chosen, out, found, _start(init, members, chosen))


def _start(init: str, members: Sequence[Recording], settings: FitSettings) -> dict[str, float]:
    """Values of the first start by name; none where it is the middle of the range."""
    if init == "middle":
        return {}
    from diffcloud.estimation.task import FitTask
    from diffcloud.jobs.starts import first_start

    return first_start(init, FitTask(members, settings))


def _sides(text: str) -> tuple[float, float]:
    parts = text.lower().split("x")
    try:
        sides = tuple(float(part) for part in parts)
    except ValueError:
        sides = ()
    if len(sides) != 2 or not all(0 < side < 10 for side in sides):
        raise ConfigError(f"--size takes two sides in metres, such as 0.40x0.30, got {text!r}.")
    return sides


def _weighed(text: str) -> tuple[float, float]:
    """Density and its standard deviation [kg/m²], of 0.24 or 0.24+-0.01."""
    value, _, error = text.replace("±", "+-").partition("+-")
    try:
        density, deviation = float(value), float(error or 0.0)
    except ValueError:
        density = deviation = math.nan
    if not (0 < density < math.inf and 0 <= deviation < density / 2):
        raise ConfigError(
            f"--density is in kg per square metre, above 0, and may have a standard deviation below half of it, as in "
            f"0.24+-0.01; got {text!r}."
        )
    return density, deviation
