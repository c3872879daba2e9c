"""3-D views of the pages: recorded clouds, simulated cloth and obstacles over time."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from diffcloud.estimation.result import FittedMotion
from diffcloud.io.episodes import ONLY_GRIPPER, Episode
from diffcloud.mesh.topology import SurfaceMesh

_DECIMALS = 4
"""Decimals of positions [m]: a tenth of a millimetre, to keep the page small."""
_COLOURS = ("target", "second", "third", "fourth")
"""Colours of the cameras, as variables of the page's style."""


@dataclass(frozen=True)
class Layer:
    """A drawn object with a checkbox that hides it. Layers with the same name share a checkbox."""

    name: str
    kind: Literal["points", "mesh", "line", "marks"]
    frames: Sequence[NDArray[Any]] | NDArray[Any]
    """Positions [N, 3] in each frame. A single array does not move."""
    color: str
    """Colour, as a variable of the page's style."""
    faces: NDArray[np.int64] | None = None
    """Faces [F, 3], for a mesh."""
    opacity: float = 0.75
    """Opacity, for a mesh."""
    labels: tuple[str, ...] = ()
    """Texts, for marks."""
    shown: bool = True
    """Whether the layer is visible at first."""


@dataclass(frozen=True)
class Overlay:
    """A drawn episode."""

    name: str
    numbers: Sequence[int]
    """[T] frame numbers in the recording."""
    times: NDArray[np.float64]
    """[T] times of the frames [s]."""
    layers: Sequence[Layer]
    opens: int = 0
    """Index of the frame that is shown first."""
    photographs: Sequence[bytes] = ()
    """A JPEG for each frame. Empty without images."""
    residuals_mm: Sequence[float | None] = ()
    """RMS residual of each frame [mm]; None if the fit did not use the frame."""

    def data(self) -> dict[str, Any]:
        """Return the data for the script of the page."""
        return {
            "name": self.name,
            "numbers": [int(number) for number in self.numbers],
            "times": [round(float(time), 3) for time in self.times],
            "opens": self.opens,
            "residuals": [None if value is None else round(value, 1) for value in self.residuals_mm],
            "layers": [
                {
                    "name": layer.name,
                    "kind": layer.kind,
                    "color": layer.color,
                    "opacity": layer.opacity,
                    "labels": list(layer.labels),
                    "shown": layer.shown,
                    "faces": None if layer.faces is None else layer.faces.T.tolist(),
                    "frames": [_axes(frame) for frame in layer.frames],
                }
                for layer in self.layers
            ],
            "photographs": [base64.b64encode(jpeg).decode() for jpeg in self.photographs],
        }


def recorded_layers(
    episode: Episode, frames: Sequence[int], *, points: int, rng: np.random.Generator, gripper: bool = True
) -> list[Layer]:
    """Return the clouds (one layer per camera if the points name theirs), the recorded grippers with their paths, and the
    positions of the cameras.

    Args:
        frames: indices of the drawn frames.
        points: maximum number of points per cloud.
        rng: random generator for the choice of points.
        gripper: whether the recorded grippers are visible at first. The recorded point may lie on the tool, centimetres
            from the cloth, so pages with a simulated cloth show its `held_layers` instead.
    """
    kept = [_few(int(size), points, rng) for size in np.diff(episode.offsets)[list(frames)]]
    chosen = [index + episode.offsets[frame] for index, frame in zip(kept, frames, strict=True)]
    names = episode.meta.get("cameras")
    if episode.camera is None or not isinstance(names, list) or len(names) <= int(episode.camera.max()):
        layers = [Layer("recorded", "points", [episode.points[index] for index in chosen], _COLOURS[0])]
    else:
        seen = [(episode.points[index], episode.camera[index]) for index in chosen]
        layers = [
            Layer(
                f"recorded, {name}",
                "points",
                [cloud[camera == number] for cloud, camera in seen],
                _COLOURS[number % len(_COLOURS)],
            )
            for number, name in enumerate(names)
        ]
    if episode.gripper is not None:
        alone = episode.grippers == ONLY_GRIPPER
        places = [episode.gripper[frame] for frame in frames]
        name, labels = "gripper, as recorded", ("",) if alone else episode.grippers
        layers.append(Layer(name, "marks", places, "soft", labels=labels, shown=gripper))
        layers += [Layer(name, "line", [track], "soft", shown=gripper) for track in np.moveaxis(episode.gripper, 1, 0)]
    if viewpoints := episode.viewpoints:
        standing = np.stack(list(viewpoints.values()))
        layers.append(Layer("cameras", "marks", [standing], "soft", labels=tuple(viewpoints), shown=False))
    return layers


def fitted_layers(motion: FittedMotion, times: NDArray[np.float64]) -> list[Layer]:
    """Return the fitted cloth with its held nodes, the cloth that the fit started from, and the bodies around it.

    Args:
        times: [T] of the frames that are drawn [s].
    """
    states = states_at(motion.times, times)
    layers = [
        Layer("fitted", "mesh", motion.nodes[states], "fitted", motion.faces),
        Layer("start of the fit", "mesh", motion.start_nodes[states], "start", motion.faces, 0.45, shown=False),
    ]
    return [*layers, *held_layers(motion.nodes[states], motion.held), *body_layers(motion.bodies)]


def held_layers(nodes: NDArray[np.float64], held: NDArray[np.int64]) -> list[Layer]:
    """Return the held nodes of a cloth and their paths. Empty if no node is held.

    Args:
        nodes: [T, V, 3] positions of the cloth in the drawn frames.
        held: [K] indices of nodes.
    """
    if not len(held):
        return []
    paths = nodes[:, held]
    marks = Layer("held nodes", "marks", paths, "held", labels=("",) * len(held))
    return [marks, *(Layer("held nodes", "line", [path], "held") for path in np.moveaxis(paths, 1, 0))]


def body_layers(bodies: SurfaceMesh) -> list[Layer]:
    """Return the bodies around the cloth."""
    return [Layer("around", "mesh", [bodies.nodes], "soft", bodies.faces, 0.5)] if len(bodies.faces) else []


def states_at(times: NDArray[np.float64], wanted: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the indices [W] of the simulated times [T] that are nearest to the wanted times."""
    return np.abs(times - np.asarray(wanted)[:, None]).argmin(axis=1)


def _few(count: int, most: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Sorted indices of at most so many of `count` points."""
    return np.arange(count) if count <= most else np.sort(rng.choice(count, most, replace=False))


def _axes(points: NDArray[Any]) -> list[list[float]]:
    """[N, 3] -> three lists."""
    columns: list[list[float]] = np.round(points.T.astype(np.float64), _DECIMALS).tolist()
    return columns
