"""What every simulator is given: a problem in SI units and in no simulator's own terms."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import ConfigError
from diffcloud.mesh.topology import ClothMesh, SurfaceMesh
from diffcloud.sim.materials import TABLE_ENTRY_TO_BENDING
from diffcloud.sim.motion import Motion

REST_HEIGHT = 0.0021
"""Of nodes that lie on a table [m]: where this simulator's contact bears a light cloth. The others get it as a radius."""

_MOTION_RATE = 480
"""[1/s] At which motions of held nodes are sampled for scripts, which interpolate linearly."""


@dataclass(frozen=True)
class Sheet:
    """An isotropic elastic sheet."""

    density: float
    """[kg/m²]"""
    stretching: float
    """E h: force per width per strain of a strip whose sides are free [N/m]."""
    poisson: float
    bending: float
    """B: bending stiffness per width of a strip whose sides are free [N·m]."""
    damping: float
    """Proportional to the stiffness [s]."""

    @property
    def shear(self) -> float:
        """μ h: shear force per width per shear angle [N/m]."""
        return self.stretching / (2 * (1 + self.poisson))

    @property
    def lateral(self) -> float:
        """λ h in plane stress [N/m]: the energy per area is μ h E:E + λ h tr(E)²/2."""
        return self.stretching * self.poisson / (1 - self.poisson**2)


@dataclass(frozen=True)
class Problem:
    """A cloth, what holds it, and perhaps a table under it. Nothing drags at it but `settling`."""

    name: str
    mesh: ClothMesh
    sheet: Sheet
    seconds: float
    held: Mapping[int, Motion | None]
    """Node -> how it is moved; None: it stays."""
    table: float | None = None
    """Its height [m]."""
    friction: float = 0.3
    """Of the cloth with the table and what else it meets."""
    self_friction: float | None = None
    """Of the cloth with itself; None: the same."""
    self_contact: bool = False
    bodies: tuple[SurfaceMesh, ...] = ()
    """What the cloth meets beside the table, standing still."""
    shaped: bool = False
    """Whether its hinges are at rest as the mesh stands, not flat."""
    gravity: float = 9.81
    """Downwards [m/s²]."""
    settling: float = 0.0
    """Drag that brings a cloth to rest, where only its rest is looked at: force per momentum [1/s]."""
    rate: float = 20.0
    """Frames a second that are compared."""

    @property
    def frictions(self) -> tuple[float, float]:
        """(with the table and bodies, of the cloth with itself)"""
        return self.friction, self.friction if self.self_friction is None else self.self_friction

    @property
    def times(self) -> NDArray[np.float64]:
        """[T] of the frames, from 0 [s]."""
        return np.arange(round(self.seconds * self.rate) + 1) / self.rate

    @property
    def node_mass(self) -> NDArray[np.float64]:
        """[V] a third of the faces around each node [kg]."""
        return self.sheet.density * self.mesh.node_area

    @property
    def hinge_stiffness(self) -> NDArray[np.float64]:
        """[H] K of the hinge energy K θ²/2 with which a free strip of this mesh bends as the sheet does [N·m]."""
        hinges = self.mesh.hinges
        area = self.mesh.face_area[hinges.faces].sum(axis=1)
        return np.asarray(self.sheet.bending / TABLE_ENTRY_TO_BENDING * hinges.length**2 / (4 * area))

    def steps_of(self, step: float) -> int:
        """How many steps of about so many seconds make a frame."""
        return max(1, round(1 / (self.rate * step)))

    def held_at(self, times: NDArray[np.floating]) -> NDArray[np.float64]:
        """[S, K, 3] where the held nodes are at times [S], in the order of `held` [m]."""
        places = []
        for node, motion in self.held.items():
            start = np.broadcast_to(self.mesh.nodes[node], (len(times), 3))
            places.append(start if motion is None else start + motion.at(times.astype(np.float64))[1])
        return np.stack(places, axis=1)

    def arrays(self) -> dict[str, Any]:
        """All of it as numbers, for the scripts that run it without this package."""
        mesh, sheet, hinges = self.mesh, self.sheet, self.mesh.hinges
        bodies = SurfaceMesh.joined(self.bodies)
        motion_times = np.linspace(0.0, self.times[-1], math.ceil(self.times[-1] * _MOTION_RATE) + 1)
        return {
            "nodes": mesh.nodes,
            "faces": mesh.faces,
            "times": self.times,
            "held": np.array(list(self.held), dtype=np.int64),
            "motion_times": motion_times,
            "motion": self.held_at(motion_times),
            "density": sheet.density,
            "shear": sheet.shear,
            "lateral": sheet.lateral,
            "membrane_gain": 1.0,
            "damping": sheet.damping,
            "hinge_edges": hinges.nodes[:, :2],
            "hinge_stiffness": self.hinge_stiffness,
            "hinge_length": hinges.length,
            "hinge_area": mesh.face_area[hinges.faces].sum(axis=1),
            "table": np.nan if self.table is None else self.table,
            "friction": self.friction,
            "self_contact": self.self_contact,
            "shaped": self.shaped,
            "body_nodes": bodies.nodes,
            "body_faces": bodies.faces,
            "gravity": self.gravity,
            "settling": self.settling,
            "radius": REST_HEIGHT,
        }


@dataclass(frozen=True)
class Track:
    """What a simulator makes of a problem."""

    nodes: NDArray[np.float64]
    """[T, V, 3] at the problem's times [m]."""
    seconds: float
    """Of processor time, without building and compiling."""


def distances(a: Track, b: Track) -> NDArray[np.float64]:
    """[T] RMS distance over nodes [m]."""
    return np.asarray(np.sqrt(((a.nodes - b.nodes) ** 2).sum(-1).mean(-1)))


PACKAGES = ("mujoco", "newton", "warp-lang")
_MODULES = {"mujoco": "mujoco", "newton": "newton", "warp-lang": "warp"}


def installed() -> dict[str, str]:
    """The other simulators' packages and their versions.

    Raises:
        ConfigError: one is missing; the message says how to install it.
    """
    missing = [name for name in PACKAGES if importlib.util.find_spec(_MODULES[name]) is None]
    if missing:
        raise ConfigError(
            f"The other simulators are not installed ({', '.join(missing)} missing). "
            "Try: pip install 'diffcloud[simulators]', or in the repository pip install -e '.[simulators]'."
        )
    return {name: version(name) for name in PACKAGES}
