"""Search for the initial state of a recorded cloth of any shape, given as a triangle mesh.

The mesh is placed on the table with either face up, in 24 directions, and aligned with the first cloud. The hypothesis with
the smallest RMS distance is chosen.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from diffcloud.errors import EpisodeError
from diffcloud.identification.hanging import CAP_M, WORST_M, both_ways, on_surface
from diffcloud.io.episodes import Episode
from diffcloud.scene.scenarios.layout import (
    GAP_M,
    HAND_M,
    Found,
    Layout,
    called,
    covered_area,
    few_points,
    flat_cloud,
    flat_course,
    own_paths,
    refuse_beside,
    refuse_table,
)
from diffcloud.scene.scenarios.surface import about_vertical, flat_points, level_frame, read_mesh

Floats = NDArray[np.float64]

MESH_FIELDS = ("up", "center_m", "yaw_deg", "table_height_m", "grippers", "rate_hz", "frames", "path")
"""Scenario fields that `find_mesh` determines."""
_TURNS = 24
_STAGES = ((300, 10, 2 * _TURNS), (1500, 30, 6))
"""Numbers of cloud points, iterations and hypotheses in both stages of the alignment."""
_FINISHED_M = 1e-5
_DAMPING = 0.02
"""Regularisation of a Gauss-Newton step, as a fraction of the number of points."""
_BESIDE_M = 0.03
_TOLD = 4
"""Number of hypotheses that messages list."""


def find_mesh(episode: Episode, cloth: Mapping[str, Any]) -> Layout:
    """Determine where and how the cloth of a mesh begins a recording.

    Args:
        episode: recording in metres, z up, with the tracks of its grippers.
        cloth: fields of a `mesh` scenario that all recordings share, such as the mesh and the material.

    Raises:
        EpisodeError: no hypothesis is within 25 mm of the first cloud, or a gripper is not at the cloth. The message has
            the distances.
        MeshError: the mesh cannot be a cloth.
    """
    assert episode.gripper is not None
    surface = read_mesh(Path(cloth["mesh"]), int(cloth["nodes"]))
    frame = level_frame(surface.nodes, surface.faces)
    warnings = few_points(episode)
    whole = flat_cloud(episode)
    height = float(np.median(whole[:, 2]))
    hands = episode.gripper[0] * [1, 1, 0]
    flats = {up: flat_points(surface.nodes, frame, up, 0.0) * [1, 1, 0] for up in ("front", "back")}
    tried = [(0.0, up, yaw, np.median(whole, axis=0)) for up in flats for yaw in np.linspace(0, 2 * np.pi, _TURNS + 1)[1:]]
    for points, steps, kept in _STAGES:
        cloud = whole[:: max(len(whole) // points, 1)] * [1, 1, 0]
        results = (
            _aligned_flat(flats[up], surface.faces, cloud, hands, place, yaw, steps) for _, up, yaw, place in tried[:kept]
        )
        tried = sorted(
            ((rms, up, turned, place) for (rms, place, turned), (_, up, _, _) in zip(results, tried, strict=False)),
            key=lambda one: one[0],
        )
    rms, up, yaw, place = tried[0]
    centre = place[:2]
    listed = _distinct([(rms, f"{up} up, {math.degrees(yaw) % 360:.0f} degrees") for rms, up, yaw, _ in tried])
    _refuse_other(rms, listed, cloth["mesh"])
    flat = flat_points(surface.nodes, frame, up, yaw)
    refuse_table(episode, whole, (math.sqrt(covered_area(whole)),) * 2)
    extent = float(np.ptp(surface.nodes, axis=0).max())
    grippers = dict[str, Any]()
    for number, name in enumerate(episode.grippers):
        first = np.array([*(episode.gripper[0, number, :2] - centre), 0.0])
        beside = float(np.linalg.norm(on_surface(first[None], flat * [1, 1, 0], surface.faces)[0] - first))
        refuse_beside(beside, extent, called(name, episode))
        if beside > _BESIDE_M:
            warnings.append(f"{called(name, episode)} begins {1e3 * beside:.0f} mm beside the cloth")
        grippers[name] = {"on_mesh_m": _rounded(_on_mesh(first, frame, up, yaw))}
    for name, path in own_paths(episode).items():
        grippers[name]["path"] = path
    course, told = flat_course(episode)
    found = {
        "up": Found(up, f"nearest to the first cloud: {listed}"),
        "center_m": Found(_rounded(centre), "where the centre of the mesh's area lies"),
        "yaw_deg": Found(round(math.degrees(yaw) % 360, 2), "direction in which the mesh is nearest to the first cloud"),
        "table_height_m": Found(
            round(height - GAP_M, 5), f"{1e3 * GAP_M:.1g} mm below the middle height of the first frame"
        ),
        "grippers": Found(grippers, "what each gripper holds: the point of the mesh at its first position"),
        **course,
    }
    return Layout(found, (*warnings, *told))


def _aligned_flat(
    flat: Floats, faces: NDArray[np.int64], cloud: Floats, hands: Floats, place: Floats, yaw: float, steps: int
) -> tuple[float, Floats, float]:
    """Align a flat mesh with a cloud, both at height 0, by translation and rotation.

    Points of the mesh are ignored if a point of the cloud is within the spacing of the cloud, or if a gripper may hide
    them. So only the outline aligns.

    Args:
        hands: [G, 3] places of the grippers.
        place, yaw: where the iteration begins: [3] of the mesh's origin, and its rotation [rad].

    Returns:
        The RMS distance [m], place and yaw.
    """
    tree = cKDTree(cloud)
    spacing = 2 * float(np.median(tree.query(cloud, k=4)[0][:, -1]))
    own = np.concatenate([flat, flat[faces].mean(axis=1)])
    centre = place * [1, 1, 0]
    for _ in range(steps):
        turn = about_vertical(yaw)
        local = (cloud - centre) @ turn.T
        outside = (local - on_surface(local, flat, faces)) @ turn
        placed = own @ turn
        far, index = tree.query(placed + centre)
        hidden = (np.linalg.norm(placed + centre - hands[:, None], axis=2) < HAND_M).any(axis=0)
        uncovered = np.where((far > spacing)[:, None] & ~hidden[:, None], cloud[index] - placed - centre, 0.0)
        normal, pull = np.zeros((3, 3)), np.zeros(3)
        for arms, ways in ((cloud - centre, outside), (placed, uncovered)):
            length = np.linalg.norm(ways, axis=1)
            active = (length > 1e-9) & (length < 2 * CAP_M)
            x, y = arms[active, 0], arms[active, 1]
            rows = np.stack([np.stack([np.ones_like(x), 0 * x, -y], 1), np.stack([0 * x, np.ones_like(x), x], 1)], 1)
            normal += np.einsum("nki,nkj->ij", rows, rows) / len(arms)
            pull += np.einsum("nki,nk->i", rows, ways[active, :2]) / len(arms)
        size = float((own[:, :2] ** 2).sum(axis=1).mean())
        step = np.linalg.solve(normal + _DAMPING * np.diag([1.0, 1.0, size]), pull)
        centre[:2] += step[:2]
        yaw += float(step[2])
        if np.abs(step[:2]).max() < _FINISHED_M and abs(step[2]) * math.sqrt(size) < _FINISHED_M:
            break
    return both_ways(cloud, flat @ about_vertical(yaw) + centre, faces), centre, yaw


def _on_mesh(point: Floats, frame: tuple[Floats, Floats], up: str, yaw: float) -> Floats:
    """Return the coordinates [3] in the mesh file of a point about the flat mesh's origin."""
    rotation, centre = frame
    flat = point @ about_vertical(-yaw)
    if up == "back":
        flat = flat * [1, -1, -1]
    return np.asarray(flat @ rotation + centre)


def _refuse_other(rms: float, listed: str, mesh: str) -> None:
    """Refuse a cloud that the mesh does not fit."""
    if rms > WORST_M:
        raise EpisodeError(
            f"The first cloud is not that of the cloth {mesh}. RMS distances of the nearest hypotheses: {listed}; at most "
            f"{1e3 * WORST_M:.0f} mm are allowed. Check that mesh and clouds are in metres, that the cloud shows the whole "
            "cloth and nothing else, and that the cloth lies flat."
        )


def _distinct(scored: Sequence[tuple[float, str]]) -> str:
    """List the first few distinct hypotheses, sorted by their RMS distances."""
    words = dict[str, float]()
    for rms, name in scored:
        words.setdefault(name, rms)
    return "; ".join(f"{name} {1e3 * rms:.0f} mm" for name, rms in list(words.items())[:_TOLD])


def _rounded(point: Floats) -> list[float]:
    return [round(float(x), 4) for x in point]
