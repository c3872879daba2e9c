"""Assign the topics of a ROS recording to depth cameras.

Topic names follow no standard: `/overhead/aligned_depth_to_color/image_raw`, `/lab/side/depth/image_raw`,
`/side_depth/image`. The camera is identified by the topic name without the words for its content.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass

from diffcloud.errors import EpisodeError

IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"

_CONTENT = {
    *("image", "images", "raw", "rect", "rectified", "compressed", "compresseddepth"),
    *("depth", "color", "colour", "rgb", "aligned", "to", "registered", "hw", "sw", "float"),
    *("points", "cloud", "pointcloud", "pointcloud2"),
}
"""Words in topic names that describe the content, not the camera."""
_HOLDERS = {"camera", "cameras", "cam", "cams"}
"""Name parts that only mean "camera"."""

Key = tuple[str, ...]
"""The parts of a topic name that identify its camera."""


@dataclass(frozen=True)
class CameraTopics:
    """Topics of one depth camera."""

    name: str
    depth: str
    info: str
    """camera_info topic of the depth images."""
    colors: tuple[str, ...]
    """Colour topics of the same camera, best candidate first. They may not be aligned to depth."""


def is_depth(topic: str, kind: str) -> bool:
    """Whether a topic has depth images."""
    return kind in (IMAGE, COMPRESSED_IMAGE) and _content(topic) == "depth"


def aligned_by_name(depth_topic: str) -> bool:
    """Whether the topic name says that depth is aligned to the colour image."""
    topic = depth_topic.lower()
    other = re.search(r"depth_to_([a-z]+)", topic)
    if other is not None:  # alignment to an infrared camera is excluded
        return other.group(1) in ("color", "colour", "rgb")
    return "align" in topic or "registered" in topic


def is_rectified(topic: str) -> bool:
    """Whether the images are undistorted, according to the naming of image_proc and depth_image_proc."""
    return any({"rect", "rectified"} & set(part.split("_")) for part in topic.lower().split("/"))


def same_camera(first: str, second: str) -> bool:
    """Whether two topic names refer to the same camera."""
    return _without_holders(_key(first)) == _without_holders(_key(second))


def info_topic(image_topic: str, topics: Mapping[str, str]) -> str | None:
    """Return the nearest camera_info topic in the same namespace as an image topic or above it, or None."""
    folder = image_topic
    while "/" in folder:
        folder = folder.rsplit("/", 1)[0]
        if topics.get(f"{folder}/camera_info") == CAMERA_INFO:
            return f"{folder}/camera_info"
    return None


def only_named(topics: Mapping[str, str], named: Collection[str], kinds: Collection[str]) -> set[str]:
    """Return the topics of some message types. If the user selected any of these, return only the selected ones."""
    found = {topic for topic, kind in topics.items() if kind in kinds}
    return found & {name.partition("#")[0] for name in named} or found


def refuse_unknown(topics: Mapping[str, str], named: Collection[str], where: str) -> None:
    """Check that all selected topics exist.

    Raises:
        EpisodeError: a topic is missing. The message lists the existing topics.
    """
    unknown = [name for name in named if name.partition("#")[0] not in topics]
    if unknown:
        raise EpisodeError(f"{where} has no topic {unknown[0]}, which --topic names; its topics are {_listed(topics)}.")


def holds_clouds(topics: Mapping[str, str], named: Collection[str], where: str) -> bool:
    """Whether a recording is read by its clouds: one of them is named, or it has no depth images.

    Args:
        topics: message type by topic.
        named: topics that the user named.
        where: the recording, for messages.

    Raises:
        EpisodeError: both clouds and depth images are named.
    """
    clouds = {topic for topic, kind in topics.items() if kind == POINT_CLOUD}
    depths = {topic for topic, kind in topics.items() if is_depth(topic, kind)}
    if clouds & set(named) and depths & set(named):
        raise EpisodeError(
            f"{where}: --topic names clouds ({_listed(clouds & set(named))}) and depth images "
            f"({_listed(depths & set(named))}). A recording is read by one of both. Name one."
        )
    return bool(clouds & set(named) or (clouds and not depths))


def cloud_cameras(topics: Mapping[str, str], where: str, named: Collection[str] = ()) -> dict[str, str]:
    """The topic of clouds of each camera, by the camera's name.

    Args:
        topics, where, named: as of `holds_clouds`.

    Raises:
        EpisodeError: several topics of clouds, of which none is named; lists them.
    """
    found = sorted(only_named(topics, named, (POINT_CLOUD,)))
    if len(found) > 1 and not set(found) <= set(named):
        raise EpisodeError(
            f"{where} has clouds on several topics: {_listed(found)}. Name the one with the cloth by --topic, such as "
            f"`--topic {found[0]}`. If several cameras show the cloth, name the topic of each."
        )
    return dict(zip(_names([_key(topic) for topic in found]), found, strict=True))


def depth_cameras(topics: Mapping[str, str], where: str, named: Collection[str] = ()) -> dict[str, CameraTopics]:
    """Find all depth cameras of a recording, by name. Depth aligned to colour is preferred.

    Args:
        topics: topic -> message type.
        where: name of the recording, for messages.
        named: topics that the user selected. For each kind of message, only these are used if there are any.

    Raises:
        EpisodeError: there is no depth topic, a camera has several equally good ones, a camera_info is missing, or two
            cameras share one. The message lists the candidates.
    """
    depths: dict[Key, str] = {}
    held = {topic: topics[topic] for topic in topics if is_depth(topic, topics[topic])}
    allowed = set(held) & set(named) or set(held)
    for rank, topic in sorted((_preference(topic, held[topic]), topic) for topic in allowed):
        other = depths.setdefault(_key(topic), topic)
        if other != topic and _preference(other, held[other]) == rank:
            raise EpisodeError(
                f"{where} has several depth topics of one camera: {other} and {topic}. Name the one to take with --topic, "
                f"such as `--topic {other}`."
            )
    if not depths:
        raise EpisodeError(f"{where} has no depth image topic; its topics are {_listed(topics)}.")
    infos: dict[str, str] = {}
    stated = only_named(topics, named, (CAMERA_INFO,))
    for topic in depths.values():
        info = info_topic(topic, dict.fromkeys(stated, CAMERA_INFO))
        if info is None and len(depths) == 1 and len(stated) == 1 and stated <= set(named):
            (info,) = stated  # a selected topic may be in any namespace
        if info is None:
            raise EpisodeError(
                f"{where} has no camera_info beside {topic}; record it, the intrinsics are in it. "
                + (
                    f"If one of {_listed(stated)} belongs to it, name it with --topic."
                    if stated
                    else "There is none at all."
                )
            )
        if info in infos:
            raise EpisodeError(
                f"{where} has one camera_info, {info}, for two cameras ({infos[info]} and {topic}): whose intrinsics it "
                "states cannot be told. Record a camera_info beside the depth of each camera."
            )
        infos[info] = topic
    shown = {
        topic: kind for topic, kind in topics.items() if kind in (IMAGE, COMPRESSED_IMAGE) and _content(topic) == "color"
    }
    colors = _colors({topic: shown[topic] for topic in set(shown) & set(named) or shown}, list(depths))
    names = _names(list(depths))
    found = {
        name: CameraTopics(name, depths[key], info, colors[key])
        for key, name, info in zip(depths, names, infos, strict=True)
    }
    return dict(sorted(found.items()))


def _listed(topics: Collection[str]) -> str:
    return ", ".join(sorted(topics)) or "none"


def _preference(topic: str, kind: str) -> tuple[bool, bool, bool]:
    """Sort key of depth topics: aligned before not aligned, then uncompressed before compressed."""
    return not aligned_by_name(topic), kind != IMAGE, "compressedDepth" not in topic


def _content(topic: str) -> str | None:
    """Return "depth", "color" or None. The last part of the name decides, since a depth camera may also have colour."""
    for part in reversed(topic.lower().split("/")):
        if "depth" in part:
            return "depth"
        if re.search("colou?r|rgb", part):
            return "color"
    return None


def _key(topic: str) -> Key:
    """Return the parts of a topic name without words for its content. May be empty."""
    kept = []
    for part in topic.strip("/").split("/"):
        # Depth aligned to an infrared camera still belongs to the depth camera.
        words = re.sub(r"depth_to_[a-z0-9]+", "depth", part, flags=re.IGNORECASE).split("_")
        rest = "_".join(word for word in words if word.lower() not in _CONTENT)
        if rest:
            kept.append(rest)
    return tuple(kept)


def _without_holders(key: Key) -> Key:
    return tuple(part for part in key if part.lower() not in _HOLDERS)


def _names(keys: list[Key]) -> list[str]:
    """Choose short unique names for the cameras from the parts of their topic names."""
    named = [_without_holders(key) or key for key in keys]
    if len(set(named)) < len(named):
        named = keys
    if len(named) == 1:
        return [named[0][-1] if named[0] else "depth"]
    first = next((index for index, parts in enumerate(zip(*named, strict=False)) if len(set(parts)) > 1), None)
    if first is not None and len({parts[first] for parts in named}) == len(named):
        return [parts[first] for parts in named]
    return ["_".join(parts) or "depth" for parts in named]


def _colors(topics: Mapping[str, str], cameras: list[Key]) -> dict[Key, tuple[str, ...]]:
    """Assign colour topics to the camera with the longest common name prefix. Ambiguous topics are dropped."""
    found: dict[Key, list[tuple[int, str]]] = {camera: [] for camera in cameras}
    for topic in topics:
        shared = {camera: _shared(_key(topic), camera) for camera in cameras}
        nearest = [camera for camera, count in shared.items() if count == max(shared.values())]
        if len(nearest) == 1 and (shared[nearest[0]] > 0 or not _key(topic) or not nearest[0]):
            found[nearest[0]].append((len(_key(topic)), topic))
    return {
        camera: tuple(topic for _, topic in sorted(held, key=lambda entry: (entry[0], topics[entry[1]] != IMAGE, entry[1])))
        for camera, held in found.items()
    }


def _shared(first: Key, second: Key) -> int:
    """Number of leading parts that two keys have in common."""
    count = 0
    for one, other in zip(first, second, strict=False):
        if one != other:
            break
        count += 1
    return count
