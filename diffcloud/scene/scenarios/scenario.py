"""A scene with the settings of an experiment: compared frames, sampled faces, bounds."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloud.errors import ConfigError, unknown_name
from diffcloud.mesh.refinement import refined
from diffcloud.scene.description import Scene
from diffcloud.sim.properties import PARAMETERS, Properties, check_values, scaled_properties
from diffcloud.sim.system import System

_NO_MATERIAL = 1e-9
"""Smaller values are treated as zero."""
Recorder = Literal["depth_cameras", "whole_surface"]
"""Source of synthetic episodes: depth cameras with noise, or noise-free points on cloth and first obstacle."""


@dataclass(frozen=True)
class Scenario:
    """A scene and the settings of an experiment with it."""

    name: str
    scene: Scene
    frames: int
    """Number of simulated frames after the start."""
    loss_frames: tuple[int, ...]
    """Frames of an episode that the loss of the paper compares; negative numbers count from the end."""
    every_frame: bool = False
    """Whether the default loss compares all usable frames instead of `loss_frames`."""
    loss_faces: NDArray[np.int64] | None = None
    """Faces whose surface the loss of the paper samples; None for all."""
    node_sets: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)
    """Parameter -> nodes on which it acts."""
    points: int = 3500
    """Number of sampled points per frame."""
    learning_rate: float = 0.2
    iterations: int = 50
    threshold: float = 0.0
    """Loss [squared length unit] below which a fit stops; 0: never."""
    length_unit_m: float = 1.0
    first_frame_time: float = 0.0
    """Time of a recorded episode's first frame since the start [s]."""
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Parameter -> bounds that replace its default ones."""
    recorder: Recorder = "depth_cameras"
    uncertain: Mapping[str, float] = field(default_factory=dict)
    """Material parameters with another uncertainty than the default -> standard deviation as a factor
    (`estimation.uncertain`)."""
    initial_state: Mapping[str, float] = field(default_factory=dict)
    """Initial-state variables that fits estimate -> standard deviation: `turn` [rad], `shape` [m], `size` and `track`
    [1] (`estimation.initial_state`)."""
    regrip: Callable[[float], Scenario] | None = None
    """Function that returns the scenario with a grasp this many standard deviations larger; None: the size is known."""

    @property
    def steps(self) -> int:
        return self.frames * self.scene.frame_steps

    @property
    def grasped(self) -> list[int]:
        """Nodes held by moving handles."""
        return [handle.node for handle in self.scene.handles.handles if handle.motion is not None]

    def with_steps(self, times: int) -> Scenario:
        """Return the same scenario with `times` as many steps per frame."""
        return replace(self, scene=replace(self.scene, frame_steps=times * self.scene.frame_steps), regrip=None)

    def finer(self) -> Scenario:
        """Return the same scenario with half the edge length (`Scene.finer`). A new node between two nodes of a set
        belongs to the set. The parts of a loss face are loss faces."""
        _, edges = refined(self.scene.mesh)
        first = len(self.scene.mesh.nodes)
        sets = {
            name: np.concatenate([nodes, first + np.flatnonzero(np.isin(edges, nodes).all(axis=1))])
            for name, nodes in self.node_sets.items()
        }
        faces = None if self.loss_faces is None else (4 * self.loss_faces[:, None] + np.arange(4)).reshape(-1)
        return replace(self, scene=self.scene.finer(), node_sets=sets, loss_faces=faces, regrip=None)

    def check_parameters(self, names: Iterable[str]) -> None:
        """Check that the parameters affect the scene.

        Raises:
            ConfigError: nothing in the scene depends on a parameter.
        """
        if "body_mass" in names and not self.scene.surrounding.bodies:
            raise ConfigError(f"body_mass has no effect in {self.name}, whose scene has no rigid bodies; leave it out.")
        if "compression" in names and not self.scene.material.wrinkles:
            raise ConfigError(
                f"compression has no effect in {self.name}, whose cloth resists compression in full; leave it out, or give "
                "the scenario a compression below 1."
            )

    def nominal(self, name: str) -> float:
        """Return the nominal value of a parameter in its unit, i.e. the value of multiplier 1. Parameters without a
        multiplier return 1."""
        quantity = PARAMETERS[name].quantity
        return 1.0 if quantity is None else self.scene.nominal(quantity)

    def multipliers(self, values: Mapping[str, float], option: str) -> dict[str, float]:
        """Convert values in SI units to the inputs of simulator and fits: multipliers of the nominal material.

        Args:
            option: origin of the values, for messages.

        Raises:
            ConfigError: a parameter is unknown or has no effect in this scene, or a value is out of range.
        """
        found = {}
        for name, value in values.items():
            if name not in PARAMETERS:
                raise ConfigError(f"{option}: {unknown_name('parameter', name, PARAMETERS)}")
            nominal = self.nominal(name)
            if not nominal > _NO_MATERIAL:
                raise ConfigError(f"{option}: {name} has no effect in {self.name}, whose own is 0; leave it out.")
            PARAMETERS[name].check(value, f"{option} {name}", nominal)
            found[name] = value / nominal
        return found

    def search_range(self, stated: Mapping[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
        """Return bounds of multipliers: the stated ones, converted from SI units, and else the scenario's own.

        Raises:
            ConfigError: see `multipliers`.
        """
        low, high = (self.multipliers({name: pair[end] for name, pair in stated.items()}, "bounds") for end in (0, 1))
        return {**self.bounds, **{name: (low[name], high[name]) for name in stated}}

    def in_si(self, values: Mapping[str, float]) -> dict[str, float]:
        """Convert multipliers to values in SI units, the inverse of `multipliers`."""
        return {name: value * self.nominal(name) for name, value in values.items()}

    def fitted_scene(self, values: Mapping[str, float]) -> Scene:
        """Return the scene with parameters applied to its material, air, friction and bodies.

        Raises:
            ConfigError: a parameter is unknown, or acts on a part of the nodes, which a material cannot express.
        """
        check_values(values, self.name)
        self.check_parameters(values)
        parts = sorted(values.keys() & self.node_sets.keys())
        if parts:
            raise ConfigError(
                f"In {self.name}, {', '.join(parts)} acts on a part of the nodes, which no material can say; fit a "
                "scenario without node sets."
            )
        scene, around = self.scene, self.scene.surrounding
        weight, air = values.get("density", 1.0), values.get("air_density", 1.0)
        material = scene.material.scaled(
            density=weight,
            stretching=values.get("stretching", 1.0),
            shear=values.get("shear", 1.0),
            bending=values.get("bending", 1.0),
        )
        heavy = values.get("body_mass", 1.0)
        bodies = tuple(
            replace(body, density=body.density * heavy, mass=None if body.mass is None else body.mass * heavy)
            for body in around.bodies
        )
        around = replace(
            around,
            air_density=around.air_density * air,
            air_drag=around.air_drag * air,
            added_mass=around.added_mass * values.get("added_mass", 1.0),
            linear_drag=around.linear_drag * values.get("linear_drag", 1.0),
            friction=values.get("friction", around.friction),
            self_friction=values.get("self_friction", around.self_friction),
            bodies=bodies,
        )
        return replace(
            scene,
            material=replace(
                material,
                compression=values.get("compression", material.compression),
                damping=values.get("damping", material.damping),
            ),
            mass_material=None if scene.mass_material is None else scene.mass_material.scaled(density=weight),
            surrounding=around,
        )

    def value(self, name: str) -> float:
        """Return the scenario's own value of a parameter, as the simulator takes it (1 for multipliers). The result is 0 if
        the parameter has no effect."""
        quantity = PARAMETERS[name].quantity
        if quantity is not None:
            return 1.0 if self.scene.nominal(quantity) > _NO_MATERIAL else 0.0
        if name == "compression" and not self.scene.material.wrinkles:
            return 0.0
        system, _ = self.scene.build()
        found = float(getattr(system.properties, name)[0])
        return found if found > _NO_MATERIAL else 0.0

    def properties(self, system: System, values: Mapping[str, Tensor]) -> Properties:
        """Return the physical properties of parameter sets, name -> [B], including the scenario's node sets.

        Raises:
            ConfigError: a parameter is unknown.
        """
        sets = {}
        for name in values.keys() & self.node_sets.keys():
            sets[name] = torch.zeros(len(system.mesh.nodes), dtype=torch.bool)
            sets[name][torch.as_tensor(self.node_sets[name])] = True
        return scaled_properties(system.properties, values, faces=torch.as_tensor(system.mesh.faces), node_sets=sets)
