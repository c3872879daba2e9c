"""All scenarios by name, and YAML files that modify a built-in one."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, overload

from pydantic import ValidationError

from diffcloud.errors import ConfigError, SceneError, unknown_name
from diffcloud.io.files import read_yaml
from diffcloud.io.schema import explain
from diffcloud.scene.registry import EXPERIMENTS, load_experiment, load_scene
from diffcloud.scene.scenarios.band import BAND_STRETCH, BandScenario, band_scenario
from diffcloud.scene.scenarios.grid import FOLD, LIFT, SHAKE, GridScenario, grid_scenario
from diffcloud.scene.scenarios.hang import HANG, HangScenario, hang_scenario
from diffcloud.scene.scenarios.recorded import RECORDED
from diffcloud.scene.scenarios.scenario import Scenario
from diffcloud.scene.scenarios.surface import MeshScenario, mesh_scenario
from diffcloud.scene.scenarios.vest import VEST_HANG, VestScenario, vest_scenario

Options = GridScenario | HangScenario | MeshScenario | BandScenario | VestScenario

_ALL: tuple[Options, ...] = (LIFT, FOLD, BAND_STRETCH, VEST_HANG, SHAKE, HANG, *RECORDED)
_BUILT_IN: dict[str, Options] = {options.name: options for options in _ALL}
_MESH = "mesh"
"""Base of a scenario file that is not built in, because it needs a mesh."""
_FILES = {"material": (".json",), "mesh": (".obj",)}
"""Field of a scenario file -> suffixes of the files that it may name."""
SCENARIO_NAMES = (*_BUILT_IN, *EXPERIMENTS)


def load_scenario(name: str | Path | None, scene: Path | None = None) -> Scenario:
    """Load a scenario by name, YAML file or scene file, or an experiment with its scene file.

    Args:
        name: a built-in scenario, a `release_*` experiment (which needs `scene`), or the path of a YAML file. None: use
            the scene file as it is.
        scene: a scene file, such as an ARCSim scene JSON.

    Raises:
        ConfigError, SceneError, MeshError: the input is invalid; names the allowed values.
    """
    if name is None:
        if scene is None:
            raise ConfigError(f"Give --scene: one of {', '.join(SCENARIO_NAMES)}, a YAML file, or an ARCSim scene JSON.")
        loaded = load_scene(scene)
        frames = loaded.default_frames or 25
        return Scenario(Path(scene).stem, loaded, frames, loss_frames=(-1,), every_frame=True)
    text = str(name)
    if text in EXPERIMENTS:
        if scene is None:
            raise ConfigError(
                f"Scenario {text} needs the published scene file, as in {text}=FILE.json (docs/published-data.md)."
            )
        return load_experiment(text, scene)
    if scene is not None:
        raise ConfigError(
            f"Scenario {text} makes its own scene; only release_* take a scene file, as in release_lift=FILE.json."
        )
    if text in _BUILT_IN:
        return make_scenario(_BUILT_IN[text])
    if Path(text).suffix in (".yaml", ".yml"):
        return make_scenario(read_options(Path(text)))
    raise ConfigError(unknown_name("scenario", text, SCENARIO_NAMES) + " Or give the path of a YAML file.")


def make_scenario(options: Options) -> Scenario:
    """Return the scenario of the given options.

    Raises:
        SceneError, MeshError: the options contradict each other.
    """
    match options:
        case GridScenario():
            return grid_scenario(options)
        case HangScenario():
            return hang_scenario(options)
        case MeshScenario():
            return mesh_scenario(options)
        case BandScenario():
            return band_scenario(options)
        case VestScenario():
            return vest_scenario(options)


@overload
def built_in(name: Literal["lift", "fold", "shake", "recorded_lift", "recorded_fold"]) -> GridScenario: ...
@overload
def built_in(name: Literal["hang"]) -> HangScenario: ...
@overload
def built_in(name: Literal["band_stretch"]) -> BandScenario: ...
@overload
def built_in(name: Literal["vest_hang"]) -> VestScenario: ...
@overload
def built_in(name: str) -> Options: ...
def built_in(name: str) -> Options:
    """Return the options of a built-in scenario.

    Raises:
        ConfigError: the name is unknown.
    """
    if name not in _BUILT_IN:
        raise ConfigError(unknown_name("built-in scenario", name, _BUILT_IN))
    return _BUILT_IN[name]


def read_options(path: Path) -> Options:
    """Read a user's scenario: `base:` with the name of a built-in one (default `lift`), and the fields that differ.

    Raises:
        SceneError: the file is unreadable, a field is unknown, or a value is out of range.
    """
    data = read_yaml(path, error=SceneError, kind="scenario file")
    if not isinstance(data, dict):
        raise SceneError(f"{path}: a scenario is a mapping of fields, got {type(data).__name__}.")
    return own_options(data, Path(path).stem, path, folder=Path(path).parent)


def with_paths(fields: Mapping[str, object], folder: Path) -> dict[str, object]:
    """Return the fields of a scenario file with absolute paths of its mesh and material, for use in another folder.

    Args:
        folder: folder of the scenario file.
    """
    files = {
        name: value for name, value in fields.items() if isinstance(value, str) and value.endswith(_FILES.get(name, ()))
    }
    return {**fields, **{name: str((folder / value).resolve()) for name, value in files.items()}}


def paths_within(fields: Mapping[str, object], folder: Path, whole: Path) -> dict[str, object]:
    """Return the fields of a scenario file. Paths of files within `whole` become relative to its folder.

    Args:
        fields: fields with absolute paths, as `with_paths` returns them.
        folder: folder of the scenario file.
        whole: folder that may be moved together with its files.
    """
    files = {name: Path(value) for name in _FILES if isinstance(value := fields.get(name), str)}
    inside = {name: path for name, path in files.items() if path.is_relative_to(whole.resolve())}
    return {**fields, **{name: os.path.relpath(path, folder.resolve()) for name, path in inside.items()}}


def own_options(fields: Mapping[str, object], name: str, source: object, *, folder: Path) -> Options:
    """Return the options from the fields of a scenario file.

    Args:
        name: name of the scenario.
        source: origin of the fields, for messages.
        folder: folder to which paths of mesh and material are relative.

    Raises:
        SceneError: a field is unknown, or a value is out of range.
    """
    data = dict(fields)
    base = data.pop("base", "lift")
    if base not in (*_BUILT_IN, _MESH):
        raise SceneError(f"{source}: " + unknown_name("base", str(base), (*_BUILT_IN, _MESH)))
    data = with_paths(data, folder)
    options = _BUILT_IN.get(str(base))
    given = {} if options is None else options.model_dump()
    if "loss_frames" in data:
        given["every_frame"] = False
    for own, other in (("grasped", "grippers"), ("grippers", "grasped")):
        if own in data:
            given.pop(other, None)
    kind = MeshScenario if options is None else type(options)
    try:
        return kind.model_validate({**given, "name": name, **data})
    except ValidationError as error:
        raise explain(source, error, SceneError) from error
