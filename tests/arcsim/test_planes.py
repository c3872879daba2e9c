"""Half-spaces: several at once, and what is held goes through them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from diffcloud.mesh import SurfaceMesh, grid_cloth, rectangle_surface
from diffcloud.sim import init, rollout, rollout_tangents
from diffcloud.sim.build import build_system
from diffcloud.sim.handles import Handle, Handles
from diffcloud.sim.materials import isotropic
from diffcloud.sim.motion import Keyframe, Motion
from diffcloud.sim.surrounding import ContactSettings, Surrounding

FABRIC = isotropic("test", density=0.3, stretching=60.0, bending=1e-5)


def slope(degrees: float) -> SurfaceMesh:
    """A large square through the origin, turned about x."""
    flat = rectangle_surface((0.0, 0.0), (2.0, 2.0), 0.0)
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return SurfaceMesh(flat.nodes @ np.array([[1, 0, 0], [0, c, s], [0, -s, c]]), flat.faces)


@pytest.mark.parametrize("angles", [(20.0, -20.0), (-10.0, 30.0)])
def test_a_node_that_two_slopes_stop_in_one_step(angles):
    """In a groove: the second projection follows the first one, and their order is turned round in reverse mode only."""
    mesh = grid_cloth(3, 3, 0.1, 0.1)
    system = build_system(
        mesh,
        FABRIC,
        time_step=0.02,
        handles=Handles(()),
        surrounding=Surrounding(
            obstacles=tuple(slope(angle) for angle in angles),
            proximity=False,
            friction=0.0,
        ),
        integrator="arcsim",
    )
    high = torch.as_tensor(mesh.nodes)[None] + torch.tensor([0.003, 0.002, 0.03], dtype=torch.float64)
    down = torch.zeros_like(high) + torch.tensor([0.0, 0.3, -4.0], dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    way = torch.randn(high.shape, dtype=torch.float64, generator=generator)

    def end(velocities):
        return rollout(system, 1, state=init(system, 1, positions=high, velocities=velocities)).positions[0, -1]

    def stopped(velocities):
        """By the first slope alone it would still be below the second."""
        points = (high + system.time_step * velocities)[0]
        normals = [torch.tensor([0.0, -np.sin(np.deg2rad(a)), np.cos(np.deg2rad(a))], dtype=torch.float64) for a in angles]
        first = points - (points @ normals[0]).clamp(max=0)[:, None] * normals[0]
        return int(((points @ normals[0] < 0) & (first @ normals[1] < 0)).sum())

    assert stopped(down) > 0
    step = 1e-5
    central = (end(down + step * way) - end(down - step * way)) / (2 * step)
    at = init(system, 1, positions=high, velocities=down)
    moves = init(system, 1, positions=torch.zeros_like(high), velocities=way)
    _, forward = rollout_tangents(
        system, 1, properties=system.properties,
        tangents=type(system.properties)(*(torch.zeros_like(one) for one in system.properties.tensors())),
        state=at, state_tangents=moves,
    )  # fmt: skip
    torch.testing.assert_close(forward[0, 0, -1], central, rtol=1e-5, atol=1e-9)
    weights = torch.randn(central.shape, dtype=torch.float64, generator=generator)
    tracked = down.clone().requires_grad_(True)
    (reverse,) = torch.autograd.grad((end(tracked) * weights).sum(), tracked)
    assert float((reverse * way).sum()) == pytest.approx(float((central * weights).sum()), rel=1e-5)


def test_a_held_node_that_goes_through_the_table_has_gradients():
    """Half of its way below: there the barrier has no value, and no force on the node counts."""
    mesh = grid_cloth(4, 4, 0.12, 0.12)
    lifted = type(mesh)(np.add(mesh.nodes, (0.0, 0.0, 0.002)), mesh.verts, mesh.vert_node, mesh.face_verts)
    path = Motion((Keyframe(0.0, (0, 0, 0)), Keyframe(0.1, (0.0, 0.0, -0.004))))
    system = build_system(
        lifted,
        FABRIC,
        time_step=0.01,
        handles=Handles((Handle(0, path),), hard=True),
        surrounding=Surrounding(
            contact=ContactSettings(1e5, 2e-3, 2e-4), obstacles=(rectangle_surface((0.0, 0.0), (1.0, 1.0), 0.0),)
        ),
        integrator="implicit",
    )
    steps = 8
    track = torch.zeros(1, steps, 1, 3, dtype=torch.float64)
    track[0, :, 0, 2] = torch.linspace(-0.0005, -0.004, steps)

    def loss(track):
        return rollout(system, steps, track=track).positions[0, -1, 1:].square().sum()

    tracked = track.clone().requires_grad_(True)
    (gradient,) = torch.autograd.grad(loss(tracked), tracked)
    assert bool(gradient.isfinite().all())
    way = torch.zeros_like(track)
    way[0, :, 0, 0] = torch.linspace(0.1, 1.0, steps)
    step = 1e-6
    central = (loss(track + step * way) - loss(track - step * way)) / (2 * step)
    assert float((gradient * way).sum()) == pytest.approx(float(central), rel=1e-4)
