"""Simulate problems in DiffCloud's own simulator."""

from __future__ import annotations

import time
from dataclasses import replace

import torch

from diffcloud.mesh.shapes import rectangle_surface
from diffcloud.scene.description import Scene
from diffcloud.sim.handles import Handle, Handles
from diffcloud.sim.materials import isotropic
from diffcloud.sim.simulate import rollout
from diffcloud.sim.surrounding import Order, Surrounding
from diffcloud.simulators.problem import Problem, Track

STEPS = 16
"""Number of time steps per frame."""
_SETTLING_PART, _SETTLING_STEPS = 1 / 25, 400
"""For problems that settle: fraction of the problem's duration per step, and number of steps. Backward Euler with such
long steps damps the motion by itself."""


def scene(problem: Problem, order: Order = 2) -> Scene:
    """Convert a problem to a scene with implicit time steps."""
    sheet = problem.sheet
    table = () if problem.table is None else (rectangle_surface((0.0, 0.0), (10.0, 10.0), problem.table),)
    return Scene(
        mesh=problem.mesh,
        material=isotropic(
            problem.name,
            density=sheet.density,
            stretching=sheet.stretching,
            bending=sheet.bending,
            poisson=sheet.poisson,
            damping=sheet.damping,
        ),
        handles=Handles(tuple(Handle(node, motion) for node, motion in problem.held.items()), hard=True),
        frame_time=1 / problem.rate,
        frame_steps=STEPS,
        surrounding=Surrounding(
            gravity=(0.0, 0.0, -problem.gravity),
            air_density=0.0,
            friction=problem.frictions[0],
            self_friction=problem.frictions[1],
            self_contact=problem.self_contact,
            obstacles=(*table, *problem.bodies),
        ),
        shaped=problem.shaped,
        integrator="implicit",
        order=order,
    )


def simulate(problem: Problem, *, steps: int = STEPS, order: Order = 2) -> Track:
    """Simulate with `steps` time steps per frame. For a problem that settles, return only start and rest state."""
    described = replace(scene(problem, order), frame_steps=steps)
    count = (len(problem.times) - 1) * steps
    if problem.settling:
        described, count = (
            replace(described, frame_time=_SETTLING_PART * problem.seconds, frame_steps=1, order=1),
            _SETTLING_STEPS,
        )
    system, _ = described.build()
    with torch.no_grad():
        rollout(system, 1)  # load kernels before the time measurement
        began = time.process_time()
        nodes = rollout(system, count).positions[0].numpy()
    return Track(nodes[:: count if problem.settling else steps], time.process_time() - began)


def mean_height(problem: Problem, stretching: float = 1.0, *, steps: int = STEPS) -> tuple[float, float, float, float]:
    """Return mean final node height [m], its derivative by log(E h) [m], and forward and backward time [s].

    Args:
        stretching: factor on E h.
    """
    system, _ = replace(scene(problem), frame_steps=steps).build()
    factor = torch.tensor(stretching, dtype=torch.float64, requires_grad=True)
    properties = replace(system.properties, stretching=system.properties.stretching * factor)
    rollout(system, 1, properties=properties).positions.sum().backward()  # load kernels before the time measurement
    properties = replace(system.properties, stretching=system.properties.stretching * factor)
    began = time.process_time()
    height = rollout(system, (len(problem.times) - 1) * steps, properties=properties).positions[0, -1, :, 2].mean()
    forward = time.process_time()
    (derivative,) = torch.autograd.grad(height, factor)
    return height.item(), derivative.item() * stretching, forward - began, time.process_time() - forward
