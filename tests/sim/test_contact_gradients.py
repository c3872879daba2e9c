"""Derivatives through smooth contact: a cloth on a sloping table with a second cloth and a box on it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from diffcloud.mesh import ClothMesh, box_surface, grid_cloth, rectangle_surface
from diffcloud.sim import Properties, State, init, rollout, rollout_tangents, scaled_properties
from diffcloud.sim.build import build_system
from diffcloud.sim.handles import Handle, Handles
from diffcloud.sim.materials import isotropic
from diffcloud.sim.motion import Keyframe, Motion
from diffcloud.sim.rigid.bodies import BodyState
from diffcloud.sim.rigid.body import RigidBody
from diffcloud.sim.surrounding import ContactSettings, Surrounding
from tests.sim.twins.rigid import rotation

STEPS = 25
FABRIC = isotropic("test", density=0.3, stretching=60.0, bending=1e-4, shear=15.0)
NAMES = ("stretching", "density", "bending", "air_density", "damping", "friction", "self_friction", "body_mass")


def two_layers(lower: ClothMesh, upper: ClothMesh, gap: float) -> ClothMesh:
    """Two cloths as one mesh, one over the other."""
    return ClothMesh(
        np.concatenate([lower.nodes, np.add(upper.nodes, (0.013, 0.007, gap))]),
        np.concatenate([lower.verts, upper.verts]),
        np.concatenate([lower.vert_node, upper.vert_node + len(lower.nodes)]),
        np.concatenate([lower.face_verts, upper.face_verts + len(lower.verts)]),
    )


def build():
    cloth = two_layers(grid_cloth(5, 5, 0.2, 0.2), grid_cloth(3, 3, 0.1, 0.1), 0.005)
    rng = np.random.default_rng(0)
    cloth = replace(cloth, nodes=cloth.nodes * [1.01, 1.01, 1] + 1e-4 * rng.normal(size=cloth.nodes.shape) + [0, 0, 0.006])
    motion = Motion((Keyframe(0.0, (0, 0, 0)), Keyframe(0.3, (-0.02, 0.0, 0.01))))
    box = box_surface([-0.02, -0.03, 0.02], [0.04, 0.03, 0.05])
    return build_system(
        cloth,
        FABRIC,
        time_step=0.01,
        handles=Handles((Handle(0, motion),), hard=True),
        integrator="implicit",
        surrounding=Surrounding(
            gravity=(2.0, 0.5, -9.0),
            contact=ContactSettings(1e5, 4e-3, 4e-4, sticking_speed=1e-2),
            obstacles=(rectangle_surface((0.0, 0.0), (4.0, 4.0), 0.0),),
            bodies=(RigidBody(box, mass=0.02, velocity=(0.2, 0.0, -0.1), angular_velocity=(0, 0, 2.0)),),
        ),
    )


def inputs(system) -> dict[str, Tensor]:
    one = torch.ones(1, dtype=torch.float64)
    found = {name: one.clone() for name in NAMES}
    found |= {"friction": 0.3 * one, "self_friction": 0.5 * one, "damping": 2e-3 * one}
    start = init(system)
    times = torch.arange(1, STEPS + 1, dtype=torch.float64)[None, :, None, None] * 0.01
    found |= {
        "centre": start.bodies.centre.clone(),
        "turn": torch.zeros(1, 1, 3, dtype=torch.float64),
        "velocity": start.bodies.velocity.clone(),
        "spin": start.bodies.angular_velocity.clone(),
        "track": times * torch.tensor([-0.05, 0.0, 0.03], dtype=torch.float64),
    }
    return found


def start_of(system, values: dict[str, Tensor]) -> State:
    state = init(system, len(values["stretching"]))
    bodies = BodyState(
        values["centre"], rotation(values["turn"]) @ state.bodies.orientation, values["velocity"], values["spin"]
    )
    return replace(state, bodies=bodies)


def properties_of(system, values: dict[str, Tensor]) -> Properties:
    named = {name: values[name] for name in NAMES}
    return scaled_properties(system.properties, named, faces=torch.as_tensor(system.mesh.faces))


def functional(system, values: dict[str, Tensor], weights: tuple[Tensor, Tensor]) -> Tensor:
    run = rollout(
        system,
        STEPS,
        properties=properties_of(system, values),
        state=start_of(system, values),
        track=values["track"],
    )
    assert run.bodies is not None
    return (run.positions[:, -1] * weights[0]).sum((1, 2)) + (run.bodies.centre[:, -1] * weights[1]).sum((1, 2))


@pytest.fixture(scope="module")
def case():
    system = build()
    generator = torch.Generator().manual_seed(1)
    weights = (
        torch.randn(34, 3, dtype=torch.float64, generator=generator),
        5 * torch.randn(1, 3, dtype=torch.float64, generator=generator),
    )
    values = {name: value.requires_grad_(True) for name, value in inputs(system).items()}
    gradients = torch.autograd.grad(functional(system, values, weights).sum(), list(values.values()))
    directions = {
        name: torch.randn(value.shape, dtype=torch.float64, generator=generator) for name, value in values.items()
    }
    reverse = {name: float((gradient * directions[name]).sum()) for name, gradient in zip(values, gradients, strict=True)}
    return system, weights, {name: value.detach() for name, value in values.items()}, directions, reverse


def test_forward_mode_agrees_with_reverse_mode(case):
    """Of the cloth's positions, which is what forward mode gives."""
    system, (weights, _), values, directions, _ = case
    inputs = {name: value.clone().requires_grad_(True) for name, value in values.items()}
    own = (weights, torch.zeros(1, 3, dtype=torch.float64))
    gradients = torch.autograd.grad(functional(system, inputs, own).sum(), list(inputs.values()))
    count = len(values)
    with torch.no_grad(), forward_ad.dual_level():
        duals = {}
        for row, (name, value) in enumerate(values.items()):
            tangent = torch.zeros(count, *value.shape[1:], dtype=torch.float64)
            tangent[row] = directions[name][0]
            duals[name] = forward_ad.make_dual(value.repeat(count, *[1] * (value.dim() - 1)), tangent)

        def moves(tensor: Tensor) -> Tensor:
            primal, tangent = forward_ad.unpack_dual(tensor)
            return torch.zeros_like(primal) if tangent is None else tangent

        start = start_of(system, duals)
        rates = State(moves(start.positions), moves(start.velocities), BodyState(*map(moves, start.bodies.tensors())))
        properties = Properties(*map(moves, properties_of(system, duals).tensors()))
        track = moves(duals["track"])
    _, found = rollout_tangents(
        system,
        STEPS,
        properties=properties_of(system, values),
        tangents=properties,
        state=start_of(system, values),
        state_tangents=rates,
        track=values["track"],
        track_tangents=track,
    )
    for row, (name, gradient) in enumerate(zip(values, gradients, strict=True)):
        expected = float((gradient * directions[name]).sum())
        assert float((found[row, 0, -1] * weights).sum()) == pytest.approx(expected, rel=1e-8, abs=1e-12), name


@pytest.mark.slow  # 104 episodes
def test_central_differences_agree(case):
    """The step is swept; what is left is truncation and rounding."""
    system, weights, values, directions, reverse = case
    sizes = (1e-3, 1e-4, 1e-5, 1e-6)
    shifts = [(name, sign * size) for name in values for size in sizes for sign in (1, -1)]
    batch = {}
    for name, value in values.items():
        batch[name] = torch.cat([value + shift * directions[name] if name == of else value for of, shift in shifts])
    with torch.no_grad():
        both = functional(system, batch, weights).reshape(len(values), len(sizes), 2)
    wrong = {}
    for row, name in enumerate(values):
        found = (both[row, :, 0] - both[row, :, 1]) / (2 * torch.tensor(sizes))
        errors = ((found - reverse[name]).abs() / max(abs(reverse[name]), 1e-9)).tolist()
        wrong[name] = min(errors)
        assert reverse[name] != 0.0, name
    print({name: f"{reverse[name]:.3e} {error:.1e}" for name, error in wrong.items()})
    assert sorted(wrong.values())[int(0.9 * len(wrong)) - 1] <= 1e-4, wrong


def test_the_episode_touches_sticks_and_slides(case):
    system, _, values, _, _ = case
    with torch.no_grad():
        run = rollout(system, STEPS, track=values["track"])
    assert run.positions[0, -1, :, 2].min() < 4e-3
    assert run.bodies.centre[0, -1, 0, 2] < run.bodies.centre[0, 0, 0, 2]
    speed = (run.positions[0, -1] - run.positions[0, -2])[:, :2].norm(dim=-1) / 0.01
    low = run.positions[0, -1, :, 2] < 4e-3
    assert (speed[low] > 1e-2).any()
