"""What steps of first and of second order do to motions that are known: vibrations, a pendulum, free flight."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.linalg import eigh

from diffcloud.arcsim.terms import kernels
from diffcloud.mesh import grid_cloth
from diffcloud.sim import init, rollout
from diffcloud.sim.build import build_system
from diffcloud.sim.compiled.data import Motion, Timing
from diffcloud.sim.handles import Handle, Handles
from diffcloud.sim.materials import isotropic
from diffcloud.sim.motion import Keyframe
from diffcloud.sim.motion import Motion as Path
from diffcloud.sim.surrounding import Surrounding
from diffcloud.sim.system import System
from tests.sim.twins.forces import Forces

_MATERIAL = isotropic("m", density=0.2, stretching=50.0, bending=1e-5, shear=10.0)
_NOTHING = Surrounding(gravity=(0.0, 0.0, 0.0), air_density=0.0)


def _system(
    time_step: float, order: int, *, surrounding: Surrounding = _NOTHING, handles=(), integrator="implicit", **options
) -> System:
    return build_system(
        options.pop("mesh", None) or grid_cloth(5, 5, 0.2, 0.2),
        options.pop("material", _MATERIAL),
        time_step=time_step,
        handles=Handles(tuple(handles), hard=True),
        surrounding=surrounding,
        integrator=integrator,
        order=order,
    )


def _energy(system: System, positions: torch.Tensor, velocities: torch.Tensor) -> np.ndarray:
    """[S] kinetic, elastic and potential [J] of states [S, V, 3]."""
    mass = system.properties.node_mass[0].numpy()[:, None]
    gravity = np.array(system.setup.surrounding.gravity)
    forces = Forces(system.mesh, system.setup.material)
    found = []
    for x, v in zip(positions.numpy(), velocities.numpy(), strict=True):
        elastic = np.zeros(1)
        rest = np.zeros_like(x)
        for name in ("stretching", "bending"):
            part = getattr(kernels, f"{name}_energy")
            part(forces.of(name), forces.parameters, Motion(x, rest, rest, rest), Timing(0.01, 0.0), elastic)
        found.append(float(elastic[0] + (mass * (0.5 * v**2 - x * gravity)).sum()))
    return np.array(found)


def _oscillator(frequency: float, time_step: float, steps: int, order: int) -> np.ndarray:
    """[S + 1] of q'' = -ω² q from q = 1 at rest: backward Euler's or BDF2's recurrence."""
    states = [(1.0, 0.0)]
    for step in range(steps):
        (q, v), share = states[-1], 1.0
        if order == 2 and step > 0:
            (q0, v0), share = states[-2], 2 / 3
            q, v = (4 * q - q0) / 3, (4 * v - v0) / 3
        h = share * time_step
        v = (v - h * frequency**2 * q) / (1 + (h * frequency) ** 2)
        states.append((q + h * v, v))
    return np.array(states)[:, 0]


@pytest.mark.parametrize("order", [1, 2])
def test_a_small_vibration_follows_the_recurrence_of_its_mode(order):
    """So numerical damping is that of the method: in 140 steps of a tenth of a radian backward
    Euler loses half the amplitude, BDF2 a three-hundredth."""
    mesh, steps = grid_cloth(5, 5, 0.2, 0.2), 60
    forces = Forces(mesh, _MATERIAL)
    stiffness = forces.stiffness("stretching", forces.motion(mesh.nodes), 1.0, 0.0)
    mass = np.repeat(forces.parameters.node_mass, 3)
    values, modes = eigh(stiffness, np.diag(mass))
    number = int(np.argmax(values > 1e-3 * values[-1]))
    frequency, mode = float(np.sqrt(values[number])), modes[:, number] / np.abs(modes[:, number]).max()
    system = _system(0.1 / frequency, order)
    start = init(system).positions + 1e-7 * torch.from_numpy(mode).reshape(1, -1, 3)
    moved = rollout(system, steps, state=init(system, positions=start)).positions[0].numpy() - mesh.nodes
    weights = mass * mode
    found = moved.reshape(steps + 1, -1) @ weights / (1e-7 * mode @ weights)
    np.testing.assert_allclose(found, _oscillator(frequency, system.time_step, steps, order), atol=1e-4)


@pytest.mark.parametrize(("integrator", "order"), [("arcsim", 1), ("implicit", 1), ("implicit", 2)])
def test_halving_the_step_divides_the_error_by_two_to_the_order(integrator, order):
    """A cloth that swings from two corners, one of which a gripper moves, in air."""
    path = Path((Keyframe(0.0), Keyframe(0.2, translation=(0.0, 0.01, 0.02))))
    surrounding = Surrounding(air_drag=0.1)
    material = replace(_MATERIAL, damping=0.005)

    def end(steps: int, order: int, integrator: str) -> torch.Tensor:
        system = _system(
            0.16 / steps,
            order,
            surrounding=surrounding,
            handles=(Handle(0), Handle(4, path)),
            material=material,
            integrator=integrator,
        )
        with torch.no_grad():
            return rollout(system, steps).positions[0, -1]

    exact = end(1024, 2, "implicit")
    errors = [float((end(steps, order, integrator) - exact).norm()) for steps in (32, 64, 128)]
    print(errors)
    for coarse, fine in itertools.pairwise(errors):
        assert 0.8 * 2**order < coarse / fine < 1.25 * 2**order


def test_a_pendulum_keeps_the_energy_that_backward_euler_loses():
    mesh = grid_cloth(4, 4, 0.3, 0.3)
    upright = np.column_stack([mesh.nodes[:, 0], 0.15 - mesh.nodes[:, 1], np.zeros(len(mesh.nodes))])  # level: a deep swing
    mesh = replace(mesh, nodes=upright)
    lost = {}
    for order in (1, 2):
        system = _system(
            0.01,
            order,
            mesh=mesh,
            material=isotropic("m", density=0.2, stretching=2000.0, bending=0.5),
            surrounding=Surrounding(air_density=0.0),
            handles=[Handle(node) for node in range(12, 16)],
        )
        with torch.no_grad():
            run = rollout(system, 200)
        energy = _energy(system, run.positions[0], run.velocities[0])
        fallen = float(system.properties.node_mass.sum()) * 9.81 * 0.15
        assert energy.max() - energy[0] < 0.01 * fallen
        lost[order] = float(energy[0] - energy[-1]) / fallen
    assert lost[1] > 0.3
    assert lost[2] < 0.1


@pytest.mark.parametrize("order", [1, 2])
def test_free_flutter_keeps_its_momentum_and_gains_no_energy(order, rng):
    """BDF2 keeps (3 p₁ - p₀)/2, what it takes for the momentum at a step's end."""
    system = _system(0.005, order)
    x = init(system).positions * torch.tensor([1.05, 0.97, 1.0], dtype=torch.float64)
    v = torch.as_tensor(0.1 * rng.normal(size=(1, 25, 3)))
    with torch.no_grad():
        run = rollout(system, 120, state=init(system, positions=x, velocities=v))
    mass = system.properties.node_mass[0, :, None]
    momentum = (mass * run.velocities[0]).sum(1)
    kept = momentum[1:] if order == 1 else 1.5 * momentum[2:] - 0.5 * momentum[1:-1]
    np.testing.assert_allclose(kept, kept[:1].repeat(len(kept), 1), atol=1e-13)
    energy = _energy(system, run.positions[0], run.velocities[0])
    assert energy[1:].max() < energy[0] * (1 + 1e-6)
    assert energy[-1] < energy[len(energy) // 2]
