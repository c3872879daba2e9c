"""Plausibility check of a motion: an unstable simulation does not always end in NaN or infinity.

Energy enters the cloth through its weight, its handles, the wind, and the pushes that other force terms declare. A possible
motion satisfies

    E ≤ 3 (K + W) + P,      K = E₀ + G (l + s) + ½ M v²,

with the kinetic energy E (E₀ at the start), the largest elastic energy W at any earlier step, and the work P of gravity
since the start. G is the weight M |g| of the mass M plus those pushes, l the cloth's size, and s the distance that the
handles have moved. v is their greatest speed, or the wind's if greater. K is a rule of thumb, so 3 is a safety factor.

If a node is farther than three times the cloth's size from every handle position of the motion, this energy must also be
sufficient for the stretch. With the elastic energy U (U₀ at the start):

    E + U ≤ 3 (K + U₀) + P.

Moving obstacles and rigid bodies count as handles of twice their speed, since cloth can bounce off them. After the last
handle releases the cloth, nodes may also move away by free fall. They are not stretched, so any greater distance is
implausible.
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
_BOUNCE = 2.0
_ROUNDING = 8 * float(np.finfo(np.float64).eps)
"""Relative rounding error of positions. Without weight and handles, only rounding moves a cloth at rest."""


@dataclass(frozen=True)
class Motion:
    """One cloth over S steps, and what moves it. Values are in the scene's units."""

    positions: Floats
    """[S + 1, V, 3] node positions."""
    time_step: float
    mass: Floats
    """[V] node masses."""
    size: float
    """Size of the cloth (`ClothMesh.size`)."""
    places: Floats
    """[S + 1, H, 3] handle positions at the start and after each step."""
    held: NDArray[np.bool_]
    """[S, H] True if a handle holds its node in a step."""
    gravity: Floats
    """[3] gravitational acceleration."""
    wind: float
    """Wind speed."""
    velocities: Floats
    """[V, 3] velocities at the start."""
    others: Floats
    """[S + 1, P, 3] points of moving obstacles and rigid bodies."""
    push: float
    """Magnitude of other forces that can add energy [N]."""

    @property
    def pull(self) -> float:
        """Weight plus `push` [N]."""
        return float(self.mass.sum()) * float(np.linalg.norm(self.gravity)) + self.push


def implausible(motion: Motion, stored: Callable[[int], float]) -> tuple[int, str] | None:
    """Return the first step (from 1) after which the motion is implausible, and the reason; None if it is plausible.

    Args:
        stored: function that returns the elastic energy after a number of steps. It is called only if the other terms
            cannot account for the motion.
    """
    fallen = _fallen(motion)
    given, work, kinetic = _energies(motion, fallen)
    found = [_too_far(motion, fallen, given, work - kinetic, stored), _too_quick(given, work, kinetic, stored)]
    return min((fault for fault in found if fault is not None), default=None)


def _energies(motion: Motion, fallen: Floats) -> tuple[Floats, Floats, Floats]:
    """K, P and E of the module's docstring after every step, each [S]; `fallen` [S] is the result of `_fallen`."""
    step, mass = motion.time_step, float(motion.mass.sum())
    velocities = np.diff(motion.positions, axis=0) / step
    kinetic = 0.5 * np.einsum("svi,svi,v->s", velocities, velocities, motion.mass)
    handles = np.linalg.norm(np.diff(motion.places, axis=0), axis=-1) * motion.held
    others = _BOUNCE * np.linalg.norm(np.diff(motion.others, axis=0), axis=-1)
    moved = np.concatenate([handles, others], axis=1).max(axis=1, initial=0.0)
    speed = np.maximum(np.maximum.accumulate(moved) / step, motion.wind)
    rounding = _ROUNDING * float(np.abs(motion.positions).max(initial=0.0)) / step
    start = 0.5 * float(motion.mass @ (motion.velocities**2).sum(axis=-1)) + 0.5 * mass * rounding**2
    given = start + motion.pull * (motion.size + np.cumsum(moved) + fallen) + 0.5 * mass * speed**2
    work = np.einsum("svi,i,v->s", motion.positions[1:] - motion.positions[0], motion.gravity, motion.mass)
    return given, work, kinetic


def _too_far(
    motion: Motion, fallen: Floats, given: Floats, spent: Floats, stored: Callable[[int], float]
) -> tuple[int, str] | None:
    """Step and reason of the first node that is too far from all handles, or None. `fallen` [S] is the result of `_fallen`,
    `given` and `spent` [S] are K and P - E of the module's docstring."""
    places = np.concatenate([motion.places[1:][motion.held], motion.others.reshape(-1, 3)])
    if not len(places):
        places = motion.positions[0]
    allowed = _SIZES * motion.size + fallen
    offsets = motion.positions[1:] - places[0]
    if (np.abs(offsets).max(axis=(1, 2)) * np.sqrt(3) <= allowed).all():  # the common case, cheap
        return None
    distance, _ = cKDTree(places).query(motion.positions[1:])
    worst = distance.max(axis=1)
    for step in np.flatnonzero(worst > allowed):
        stretched = motion.held[step].any() or motion.others.shape[1] > 0  # a free cloth is not stretched by its weight
        if not stretched or stored(int(step) + 1) > _ENERGIES * (given[step] + stored(0)) + spent[step]:
            return int(step) + 1, (
                f"a node is {worst[step]:.3g} from everything that held the cloth, whose size is {motion.size:.3g} "
                "(scene's unit), and its weight cannot have stretched it so far"
            )
    return None


def _fallen(motion: Motion) -> Floats:
    """[S] the largest distance that a node can have fallen since the last handle released the cloth."""
    count = len(motion.positions) - 1
    holding = motion.held.any(axis=1)
    last = np.maximum.accumulate(np.where(holding, np.arange(1, count + 1), 0))
    free = (np.arange(1, count + 1) - last) * motion.time_step
    speed = np.linalg.norm(np.diff(motion.positions, axis=0), axis=-1).max(axis=1) / motion.time_step
    begin = np.concatenate([[np.linalg.norm(motion.velocities, axis=-1).max()], speed])[last]
    return np.asarray(0.5 * motion.pull / motion.mass.sum() * free**2 + (begin + motion.wind) * free)


def _too_quick(given: Floats, work: Floats, kinetic: Floats, stored: Callable[[int], float]) -> tuple[int, str] | None:
    most = 0.0
    known = 0
    for after in np.flatnonzero(kinetic > _ENERGIES * given + work):  # empty if the motion is plausible
        while known <= after:
            most = max(most, stored(known))
            known += 1
        allowed = _ENERGIES * (given[after] + most) + work[after]
        if kinetic[after] > allowed:
            return int(after) + 1, (
                f"the cloth has a kinetic energy of {kinetic[after]:.3g}, where gravity and handles can have given it "
                f"{allowed:.3g} at most (energies of the scene)"
            )
    return None
