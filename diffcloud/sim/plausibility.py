"""Whether a motion can be one: a step that has become unstable does not always leave the numbers.

Two laws that a held cloth keeps, with room: no node is farther than three times the cloth's size from every place where a
handle has been, and its kinetic energy E is not far above what can have come into it,

    E ≤ 3 (E₀ + M |g| (l + s) + ½ M v² + W),

with the mass M, the size l, the handles' path s and greatest speed v (the wind's, where that is greater), and W the most
elastic energy that was stored before. Nodes that nothing holds may have fallen freely since they were let go; moving
obstacles and rigid bodies count like handles.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Floats = NDArray[np.float64]

_SIZES = 3.0
_ENERGIES = 3.0


@dataclass(frozen=True)
class Motion:
    """One cloth over S steps, and what moves it. In the scene's units."""

    positions: Floats
    """[S + 1, V, 3]"""
    time_step: float
    mass: Floats
    """[V]"""
    size: float
    """Of the cloth: `ClothMesh.size`."""
    places: Floats
    """[S + 1, H, 3] where the handles are, at the start and after each step."""
    held: NDArray[np.bool_]
    """[S, H] which of them hold in each step."""
    gravity: float
    """Its size."""
    wind: float
    """Speed of the air."""
    velocities: Floats
    """[V, 3] at the start."""
    others: Floats
    """[S + 1, P, 3] points of moving obstacles and rigid bodies."""


def implausible(motion: Motion, stored: Callable[[int], float]) -> tuple[int, str] | None:
    """The first step (from 1) after which the motion is not plausible, and why; None if it is.

    Args:
        stored: elastic energy after so many steps; asked only where the other terms do not explain the motion.
    """
    found = [fault for fault in (_too_far(motion), _too_quick(motion, stored)) if fault is not None]
    return min(found, default=None)


def _too_far(motion: Motion) -> tuple[int, str] | None:
    places = np.concatenate([motion.places[1:][motion.held], motion.others.reshape(-1, 3)])
    if not len(places):
        places = motion.positions[0]
    allowed = _SIZES * motion.size + _fallen(motion)
    offsets = motion.positions[1:] - places[0]
    if (np.abs(offsets).max(axis=(1, 2)) * np.sqrt(3) <= allowed).all():  # the common case, at little cost
        return None
    distance, _ = cKDTree(places).query(motion.positions[1:])
    worst = distance.max(axis=1)
    beyond = np.flatnonzero(worst > allowed)
    if not len(beyond):
        return None
    step = int(beyond[0])
    return step + 1, (
        f"a node is {worst[step]:.3g} from everything that held the cloth, whose size is {motion.size:.3g} (scene's unit)"
    )


def _fallen(motion: Motion) -> Floats:
    """[S] how far a node can have fallen since nothing held the cloth."""
    count = len(motion.positions) - 1
    holding = motion.held.any(axis=1)
    last = np.maximum.accumulate(np.where(holding, np.arange(1, count + 1), 0))
    free = (np.arange(1, count + 1) - last) * motion.time_step
    speed = np.linalg.norm(np.diff(motion.positions, axis=0), axis=-1).max(axis=1) / motion.time_step
    begin = np.concatenate([[np.linalg.norm(motion.velocities, axis=-1).max()], speed])[last]
    return np.asarray(0.5 * motion.gravity * free**2 + (begin + motion.wind) * free)


def _too_quick(motion: Motion, stored: Callable[[int], float]) -> tuple[int, str] | None:
    step, mass = motion.time_step, float(motion.mass.sum())
    velocities = np.diff(motion.positions, axis=0) / step
    kinetic = 0.5 * np.einsum("svi,svi,v->s", velocities, velocities, motion.mass)
    handles = np.linalg.norm(np.diff(motion.places, axis=0), axis=-1) * motion.held
    others = np.linalg.norm(np.diff(motion.others, axis=0), axis=-1)
    moved = np.concatenate([handles, others], axis=1).max(axis=1, initial=0.0)
    speed = np.maximum(np.maximum.accumulate(moved) / step, motion.wind)
    fallen = _fallen(motion)
    start = 0.5 * float(motion.mass @ (motion.velocities**2).sum(axis=-1))
    given = start + mass * motion.gravity * (motion.size + np.cumsum(moved) + fallen) + 0.5 * mass * speed**2
    most = 0.0
    known = 0
    for after in np.flatnonzero(kinetic > _ENERGIES * given):  # none, where the motion is plausible
        while known <= after:
            most = max(most, stored(known))
            known += 1
        if kinetic[after] > _ENERGIES * (given[after] + most):
            return int(after) + 1, (
                f"the cloth has a kinetic energy of {kinetic[after]:.3g}, where gravity and handles can have given it "
                f"{given[after] + most:.3g} (energies of the scene)"
            )
    return None
