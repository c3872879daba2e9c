"""Definition of a test problem in SI units, independent of the conventions of any simulator."""

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
"""Height of nodes at rest on a table [m] in DiffCloud, for a light cloth. Others use it as node radius."""

_MOTION_RATE = 480
"""Sampling rate of held-node motions for the scripts, which interpolate linearly [1/s]."""


@dataclass(frozen=True)
class Sheet:
    """An isotropic elastic sheet."""

    density: float
    """Mass per area [kg/m²]."""
    stretching: float
    """E h: force per width per strain of a strip with free sides [N/m]."""
    poisson: float
    bending: float
    """B: bending stiffness per width of a strip with free sides [N·m]."""
    damping: float
    """Coefficient of stiffness-proportional damping [s]."""

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
    """A cloth, its held nodes, and optional obstacles. The only external damping is `settling`."""

    name: str
    mesh: ClothMesh
    sheet: Sheet
    seconds: float
    held: Mapping[int, Motion | None]
    """Held node -> its motion. None: fixed."""
    table: float | None = None
    """Height of the table [m]. None: no table."""
    friction: float = 0.3
    """Friction coefficient between cloth and obstacles."""
    self_friction: float | None = None
    """Friction coefficient of the cloth with itself. None: same as `friction`."""
    self_contact: bool = False
    bodies: tuple[SurfaceMesh, ...] = ()
    """Static obstacles besides the table."""
    shaped: bool = False
    """True: hinges are at rest in the shape of the mesh. False: the rest shape is flat."""
    gravity: float = 9.81
    """Gravity, downwards [m/s²]."""
    settling: float = 0.0
    """Drag coefficient, force per momentum [1/s]. It brings the cloth to rest if only the rest state matters."""
    rate: float = 20.0
    """Frame rate of the comparison [1/s]."""

    @property
    def frictions(self) -> tuple[float, float]:
        """Friction coefficients: (with obstacles, of the cloth with itself)."""
        return self.friction, self.friction if self.self_friction is None else self.self_friction

    @property
    def times(self) -> NDArray[np.float64]:
        """[T] frame times, from 0 [s]."""
        return np.arange(round(self.seconds * self.rate) + 1) / self.rate

    @property
    def node_mass(self) -> NDArray[np.float64]:
        """[V] lumped masses: a third of the adjacent faces [kg]."""
        return self.sheet.density * self.mesh.node_area

    @property
    def hinge_stiffness(self) -> NDArray[np.float64]:
        """[H] hinge stiffness K (energy K θ²/2) with which a free strip of this mesh bends like the sheet [N·m]."""
        hinges = self.mesh.hinges
        area = self.mesh.face_area[hinges.faces].sum(axis=1)
        return np.asarray(self.sheet.bending / TABLE_ENTRY_TO_BENDING * hinges.length**2 / (4 * area))

    def steps_of(self, step: float) -> int:
        """Return the number of steps per frame for a time step of about `step` seconds."""
        return max(1, round(1 / (self.rate * step)))

    def held_at(self, times: NDArray[np.floating]) -> NDArray[np.float64]:
        """[S, K, 3] positions of the held nodes at times [S], in the order of `held` [m]."""
        places = []
        for node, motion in self.held.items():
            start = np.broadcast_to(self.mesh.nodes[node], (len(times), 3))
            places.append(start if motion is None else start + motion.at(times.astype(np.float64))[1])
        return np.stack(places, axis=1)

    def arrays(self) -> dict[str, Any]:
        """Return the problem as arrays and numbers, for scripts that run without this package."""
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
    """Result of a simulation."""

    nodes: NDArray[np.float64]
    """[T, V, 3] node positions at the problem's frame times [m]."""
    seconds: float
    """CPU time of the simulation [s], without model building and compilation."""


def distances(a: Track, b: Track) -> NDArray[np.float64]:
    """[T] RMS distance over the nodes [m]."""
    return np.asarray(np.sqrt(((a.nodes - b.nodes) ** 2).sum(-1).mean(-1)))


PACKAGES = ("mujoco", "newton", "warp-lang")
_MODULES = {"mujoco": "mujoco", "newton": "newton", "warp-lang": "warp"}


def installed() -> dict[str, str]:
    """Return package -> version of the other simulators.

    Raises:
        ConfigError: a package is missing. The message explains how to install it.
    """
    missing = [name for name in PACKAGES if importlib.util.find_spec(_MODULES[name]) is None]
    if missing:
        raise ConfigError(
            f"The other simulators are not installed ({', '.join(missing)} missing). "
            "Try: pip install 'diffcloud[simulators]', or in the repository pip install -e '.[simulators]'."
        )
    return {name: version(name) for name in PACKAGES}
