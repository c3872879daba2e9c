"""The scene of each recording of a cloth, in files that the user may edit: OUT/cloth.yaml and OUT/recordings.yaml."""

from __future__ import annotations

import filecmp
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from diffcloud.console import warn
from diffcloud.errors import ConfigError, DiffCloudError, EpisodeError
from diffcloud.identification import found_cloth, found_layout, missing_fields, prepared, starts_hanging
from diffcloud.io.episodes import Episode, read_episode, write_episode
from diffcloud.io.files import files_in, read_json, read_yaml, together, write_json, write_text
from diffcloud.io.fingerprints import fingerprint
from diffcloud.io.grippers import tracks_beside
from diffcloud.io.imports import cloud_folder
from diffcloud.io.obj import copy_mesh
from diffcloud.io.recordings import write_recording
from diffcloud.io.ros.recording import ros_recording
from diffcloud.jobs.preprocess import PreprocessJob
from diffcloud.jobs.scenarios import own_scene
from diffcloud.jobs.settings import Config
from diffcloud.scene.scenarios.catalogue import make_scenario, own_options, with_paths
from diffcloud.scene.scenarios.layout import Found

MESH = "cloth.obj"
"""Copy of the mesh in the folder of a fit."""
_BAGS = (".bag", ".mcap", ".db3")
_HEAD = "# Found by diffcloud fit, with the reason beside each value. Edit and run the command again to overrule."


def find_scene(
    recordings: Sequence[Path],
    out: Path,
    size: tuple[float, float] | None,
    mass: float | None,
    topics: Sequence[str] = (),
    mesh: Path | None = None,
) -> tuple[dict[str, Episode], dict[str, Any], dict[str, dict[str, Any]]]:
    """Read the recordings and their scene. Values missing in cloth.yaml and recordings.yaml are estimated and added.

    Args:
        topics: topics of ROS recordings to use if there are several candidates (`ros_recording`).

    Returns:
        Recording -> episode; the scenario fields of the cloth; recording -> its own scenario fields.

    Raises:
        EpisodeError: a recording cannot be used.
        ConfigError, SceneError: a file has invalid values, or topics are given without a ROS recording.
    """
    names = named_recordings(recordings)
    episodes = read_all(names, out, topics)
    path = out / "recordings.yaml"
    with together():  # after an error, no partial result may affect the next run
        cloth = _cloth(out, episodes, size, mass, mesh)
        if starts_hanging(cloth):
            episodes = {name: _prepared(name, episode, out) for name, episode in episodes.items()}
        stated = read_fields(path).keys() if path.is_file() else set[str]()
        layouts = _layouts(out, episodes, names, cloth)
        _warn_of_changes(out, episodes, stated)
    if _same(out / MESH, cloth.get("mesh")):
        cloth = {**cloth, "mesh": str((out / MESH).resolve())}
    return episodes, cloth, layouts


def _prepared(name: str, episode: Episode, out: Path) -> Episode:
    """The recording of a hanging cloth as fits take it, kept in OUT/episodes/ too."""
    found, sentence = prepared(episode)
    if sentence:
        warn(f"{name}: {sentence}.")
    write_episode(out / "episodes" / f"{name}.npz", found)
    return found


def read_all(names: Mapping[str, Path], out: Path, topics: Sequence[str] = (), *, keep: bool = True) -> dict[str, Episode]:
    """Read recordings: name -> path to name -> episode.

    Args:
        keep: also copy episode files to OUT/episodes/. Other recordings are always stored there.

    Raises:
        EpisodeError: a recording cannot be used.
        ConfigError: topics are given without a ROS recording.
    """
    if topics and not any(map(_is_bag, names.values())):
        raise ConfigError("--topic chooses among the topics of a ROS recording, and none was given. Leave --topic out.")
    return {name: read_recording(path, name, out, topics, keep=keep) for name, path in names.items()}


def named_recordings(recordings: Sequence[Path]) -> dict[str, Path]:
    """Return recording name -> path. A folder of episode files stands for all its files.

    Raises:
        ConfigError: a recording does not exist, or two have the same name.
    """
    named: dict[str, Path] = {}
    for path in [one for given in recordings for one in files_in(given, ".npz") or [given]]:
        if not path.exists():
            raise ConfigError(f"No such recording: {path}.")
        name = path.stem if path.is_file() else path.absolute().name
        if name in named:
            raise ConfigError(f"Two recordings are named {name}; rename one.")
        named[name] = path
    return named


def _is_bag(path: Path) -> bool:
    return path.suffix in _BAGS or (path / "metadata.yaml").is_file()


def read_recording(path: Path, name: str, out: Path, topics: Sequence[str], *, keep: bool) -> Episode:
    """Read a recording as an episode. See `read_all`."""
    kept = out / "episodes" / f"{name}.npz"
    clouds = _is_bag(path) and _holds_clouds(path, topics)
    if _is_bag(path) and not clouds:
        path = _unpacked(path, out / "recordings" / name, topics)
    if clouds:
        from diffcloud.jobs.imports import cloud_recording, ros_choices

        episode, _ = cloud_recording([path], ros_choices(None, None, None, None, list(topics), None))
    elif path.is_file():
        episode = read_episode(path)
        if not keep:
            return episode
    elif (path / "episode.json").is_file():
        job = PreprocessJob("episodes", path.absolute(), out, Config().preprocess, None)
        for message in job.run(lambda done, text: None).warnings:
            warn(f"{name}: {message}")
        return read_episode(kept)
    else:
        episode = cloud_folder(path, grippers=tracks_beside(path))
    write_episode(kept, episode)
    return episode


def _holds_clouds(bag: Path, topics: Sequence[str]) -> bool:
    """Whether a recording is read by its clouds, as by `data import`."""
    from diffcloud.io.ros.surfaces import is_cloud_recording
    from diffcloud.jobs.imports import recording_kind

    return recording_kind(bag) == "ros" and is_cloud_recording([bag], topics)


def _unpacked(bag: Path, folder: Path, topics: Sequence[str]) -> Path:
    """Convert a ROS recording to a raw episode in OUT/recordings/, as `data import` does by default."""
    from diffcloud.jobs.imports import recording_kind, robot_description

    if recording_kind(bag) != "ros":
        raise EpisodeError(
            f"{bag} is a recording of the RealSense SDK, which does not say where the camera stands: make a raw episode of "
            "it first, by `diffcloud data import NAME=FILE` and a calibration."
        )
    files = sorted(bag.rglob("*")) if bag.is_dir() else [bag]
    source: dict[str, Any] = {"files": [[one.name, one.stat().st_size, one.stat().st_mtime_ns] for one in files]}
    if topics:
        source["topics"] = sorted(topics)
    told = folder.with_name(f"{folder.name}.source.json")
    if not folder.is_dir():
        write_recording(folder, ros_recording(bag, description=partial(robot_description, None), topics=topics))
        write_json(told, source)
    elif not told.is_file() or read_json(told) != source:
        raise EpisodeError(
            f"{folder} was made of another {bag.name} than {bag} is now, or with other topics. Remove {folder} to have it "
            "made anew."
        )
    return folder


def _cloth(
    out: Path,
    episodes: Mapping[str, Episode],
    stated: tuple[float, float] | None,
    mass: float | None,
    mesh: Path | None,
) -> dict[str, Any]:
    """Return the fields of cloth.yaml. If the file does not exist, detect and write them."""
    path = out / "cloth.yaml"
    if path.is_file():
        fields = read_fields(path)
        _refuse_missing(missing_fields(fields), str(path))
        own_options(fields, "cloth", path, folder=out)
        fields = with_paths(fields, out)  # resolve the paths, because scenarios are written to another folder
        if stated is not None and list(stated) != fields.get("size_m"):
            told = "x".join(f"{side:g}" for side in stated)
            warn(f"{path} says size_m {fields.get('size_m')}, and that counts, not --size {told}: edit the file.")
        if mesh is not None and not _same(mesh, fields.get("mesh")):
            warn(f"{path} says mesh {fields.get('mesh')}, and that counts, not --mesh {mesh}: edit the file.")
        return fields
    found = found_cloth(list(episodes.values()), stated, mass, mesh)
    fields = {name: entry.value for name, entry in found.items()}
    if mesh is not None:  # a copy, so that the folder of the fit is complete
        if not _same(mesh, str(out / MESH)):
            copy_mesh(mesh, out / MESH)
        found["mesh"] = replace(found["mesh"], value=MESH)
    write_text(path, _yaml(found))
    return fields


def _same(mesh: Path, other: object) -> bool:
    """Return whether both are files with the same contents."""
    return isinstance(other, str) and mesh.is_file() and Path(other).is_file() and filecmp.cmp(mesh, other, shallow=False)


def _layouts(
    out: Path, episodes: Mapping[str, Episode], sources: Mapping[str, Path], cloth: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """Return the fields of each recording in recordings.yaml. Detect and write those that are missing."""
    path = out / "recordings.yaml"
    known = read_fields(path) if path.is_file() else {}
    blocks, layouts = [path.read_text().rstrip()] if known else [_HEAD], {}
    for name, episode in episodes.items():
        if name in known:
            if not isinstance(known[name], dict):
                raise ConfigError(f"{path}: {name} must be a mapping of a scenario's fields, got {known[name]!r:.60}.")
            layouts[name] = dict(known[name])
            _refuse_missing(missing_fields(cloth, layouts[name]), f"{path}: {name}")
            where = f"{out / 'cloth.yaml'} with {name} of {path}"
            options = own_options({**cloth, **layouts[name]}, name, where, folder=out)
            try:
                make_scenario(options)
            except DiffCloudError as error:
                raise ConfigError(f"{where}: {error}") from error
            continue
        try:
            layout = found_layout(episode, cloth)
        except EpisodeError as error:
            raise EpisodeError(f"{sources[name]}: {error}") from error
        for message in layout.warnings:
            warn(f"{name}: {message}.")
        layouts[name] = {key: entry.value for key, entry in layout.fields.items()}
        lines = _yaml(layout.fields, head=False).splitlines()
        blocks.append("\n".join([f"{_inline(name)}:", *(f"  {line}" for line in lines)]))
    write_text(path, "\n".join(blocks) + "\n")
    return layouts


def _warn_of_changes(out: Path, episodes: Mapping[str, Episode], stated: Collection[str]) -> None:
    """Warn about recordings that have changed since their block in recordings.yaml was written.

    Args:
        stated: recordings that had a block before this run.
    """
    path = out / "stages" / "recordings.json"
    told = read_json(path) if path.is_file() else {}
    known = {name: mark for name, mark in told.items() if name in stated} if isinstance(told, dict) else {}
    for name, one in episodes.items():
        mark = fingerprint([one.points, one.times, one.gripper], packages=())
        if known.setdefault(name, mark) != mark:
            warn(
                f"{name} is another recording than that which its block in {out / 'recordings.yaml'} was made for, and the "
                "block counts. Remove it to have the layout found anew."
            )
    write_json(path, known)


def _refuse_missing(missing: Sequence[str], where: str) -> None:
    """Refuse missing fields. Otherwise defaults of the built-in scenario would silently replace them."""
    if missing:
        raise ConfigError(f"{where} lacks {', '.join(missing)}. Put it back, or remove the whole to have it found anew.")


def read_fields(path: Path) -> dict[str, Any]:
    told = read_yaml(path, error=ConfigError)
    if not isinstance(told, dict):
        raise ConfigError(f"{path} must be a mapping, got {type(told).__name__}. Remove it to have it written anew.")
    return told


def _yaml(found: Mapping[str, Found], *, head: bool = True) -> str:
    lines = [_HEAD] if head else []
    lines += [f"{name}: {_inline(entry.value)}  # {entry.reason}" for name, entry in found.items()]
    return "\n".join(lines) + "\n"


def _inline(value: Any) -> str:
    """Format a value as YAML in one line. Strings that YAML would read as another type, such as 001, are quoted."""
    text: str = yaml.safe_dump(value, default_flow_style=True, width=1000, sort_keys=False)
    return text.strip().removesuffix("...").strip()


def scene_fields(source: str) -> dict[str, Any] | None:
    """Return the fields of a scene's YAML file, with the resolved path of its material.

    None for a built-in or a scene JSON, which later commands find by name.
    """
    path = own_scene(source)
    return None if path is None else with_paths(read_fields(path), path.parent)
