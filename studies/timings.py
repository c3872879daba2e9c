"""Timing one episode, forward and with gradient, over batch sizes and mesh sizes; and its comparison with a recording."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from diffcloud.arcsim.contact.nearest import pairs_at
from diffcloud.clouds.neighbours import NeighbourIndex
from diffcloud.clouds.sampling import SurfaceSampler
from diffcloud.estimation.matching import nearest_places, pairs_forth
from diffcloud.mesh import grid_cloth, sphere_surface
from diffcloud.scene.scenarios import Scenario
from diffcloud.sim.build import build_system
from diffcloud.sim.handles import Handles
from diffcloud.sim.materials import preset
from diffcloud.sim.properties import scaled_properties
from diffcloud.sim.simulate import rollout, rollout_tangents
from diffcloud.sim.surrounding import ContactSettings, ReferenceContact, Surrounding
from diffcloud.sim.system import System

TANGENTS = 10


@dataclass(frozen=True)
class Timing:
    """Seconds of one whole batch, the smallest of several repeats."""

    nodes: int
    steps: int
    batch: int
    forward: float
    forward_backward: float
    forward_tangents: float
    """With ten directions of the parameters carried along."""


def time_episode(scenario: Scenario, *, batch: int, repeats: int = 3) -> Timing:
    """Time rollouts of a scenario with gradients of stretching and density.

    The loss is the mean square of the last positions: the cost of the simulation alone.
    """
    system, _ = scenario.scene.build()

    def once(backward: bool) -> float:
        values = {
            name: torch.linspace(0.5, 2.0, batch, dtype=torch.float64).requires_grad_(backward)
            for name in ("stretching", "density")
        }
        begin = time.perf_counter()
        with torch.set_grad_enabled(backward):
            run = rollout(system, scenario.steps, properties=scenario.properties(system, values))
            loss = run.positions[:, -1].square().mean()
        if backward:
            loss.backward()
        return time.perf_counter() - begin

    def along() -> float:
        values = {name: torch.linspace(0.5, 2.0, batch, dtype=torch.float64) for name in ("stretching", "density")}
        properties = scenario.properties(system, values)
        tangents = properties.repeated(TANGENTS)
        begin = time.perf_counter()
        rollout_tangents(system, scenario.steps, properties=properties, tangents=tangents)
        return time.perf_counter() - begin

    once(True)
    along()
    return Timing(
        nodes=len(system.mesh.nodes),
        steps=scenario.steps,
        batch=batch,
        forward=min(once(False) for _ in range(repeats)),
        forward_backward=min(once(True) for _ in range(repeats)),
        forward_tangents=min(along() for _ in range(repeats)),
    )


@dataclass(frozen=True)
class MatchingTiming:
    """Seconds in which simulated points of all frames find their recorded partners, and recorded ones their places on the
    cloth."""

    frames: int
    points: int
    """Of a frame, each way."""
    first: float
    again: float
    """Where partners of a pose a millimetre away are known."""


def time_matching(scenario: Scenario, points: int, *, repeats: int = 5) -> MatchingTiming:
    """Time one comparison of a motion with clouds of 3,500 points a frame, which another cloth made, with 2 mm of noise."""
    system, _ = scenario.scene.build()
    faces, generator = torch.as_tensor(system.mesh.faces), torch.Generator().manual_seed(0)
    values = {"stretching": torch.tensor([1.0, 1.3], dtype=torch.float64)}
    nodes = rollout(system, scenario.steps, properties=scenario.properties(system, values)).positions
    nodes = nodes[:, scenario.scene.frame_steps :: scenario.scene.frame_steps]
    recorded = SurfaceSampler.build(faces, 3500, generator=generator, dtype=torch.float64).sample(nodes[:1])[0]
    recorded = recorded + 0.002 * torch.randn(recorded.shape, generator=generator, dtype=torch.float64)
    clouds = [NeighbourIndex(cloud) for cloud in recorded]
    places = SurfaceSampler.build(faces, points, generator=generator, dtype=torch.float64).draw(nodes[1:])
    moved, queries = places.of(nodes[1:]), recorded[None, :, :points]

    def once(known: tuple[Tensor, Tensor] | tuple[None, None], shift: float) -> tuple[float, tuple[Tensor, Tensor]]:
        begin = time.perf_counter()
        _, forth = pairs_forth(places, [moved + shift], [clouds], crop=None, share=0.5, guesses=known[0])
        _, back = nearest_places(nodes[1:], faces, queries - shift, known[1])
        return time.perf_counter() - begin, (forth, back)

    _, known = once((None, None), 0.0)  # builds the trees
    return MatchingTiming(
        frames=len(clouds),
        points=points,
        first=min(once((None, None), 0.001)[0] for _ in range(repeats)),
        again=min(once(known, 0.001)[0] for _ in range(repeats)),
    )


@dataclass(frozen=True)
class ContactTiming:
    """Seconds of a cloth that falls onto a sphere, forward and with gradient, and of one that falls through the air."""

    nodes: int
    steps: int
    contacts: float
    """Repelling pairs, the mean over the steps."""
    touching: float
    free: float

    @property
    def per_contact(self) -> float:
        """Seconds that one contact adds to one step, with its gradient."""
        return (self.touching - self.free) / (self.steps * self.contacts)


def time_contact(side: int, *, steps: int = 25, repeats: int = 3) -> ContactTiming:
    """Time a square cloth of side x side nodes, half a metre wide, that is dropped on a sphere of 0.3 m.

    The same cloth, sphere and steps for all sides; only the mesh is finer.
    """
    mesh = grid_cloth(side, side, 0.5, 0.5)
    mesh = replace(mesh, nodes=mesh.nodes + np.array([0.0, 0.0, 0.005]))
    sphere = sphere_surface((0.0, 0.0, -0.15), 0.15, subdivisions=3)

    def build(surrounding: Surrounding) -> System:
        return build_system(
            mesh,
            preset("soft-knit"),
            time_step=0.01,
            handles=Handles(()),
            surrounding=surrounding,
            integrator="arcsim",
        )

    contact = ContactSettings(1e5, 0.004, 0.0004)
    touching = build(Surrounding(obstacles=(sphere,), contact=contact, reference_contact=ReferenceContact()))
    free = build(Surrounding())

    def once(system: System) -> float:
        values = {name: torch.ones(1, dtype=torch.float64, requires_grad=True) for name in ("stretching", "density")}
        begin = time.perf_counter()
        properties = scaled_properties(system.properties, values, faces=torch.as_tensor(system.mesh.faces))
        rollout(system, steps, properties=properties).positions[:, -1].square().mean().backward()
        return time.perf_counter() - begin

    with torch.no_grad():
        positions = rollout(touching, steps).positions[0].numpy()
    scene = touching.scene
    contacts = sum(
        len(pairs_at(scene.surface, scene.repulsion, np.concatenate([one, scene.obstacles]))[0]) for one in positions
    )
    return ContactTiming(
        nodes=len(mesh.nodes),
        steps=steps,
        contacts=contacts / len(positions),
        touching=min(once(touching) for _ in range(repeats)),
        free=min(once(free) for _ in range(repeats)),
    )
