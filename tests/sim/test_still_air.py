"""Air that moves with a cloth has inertia and no weight."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from diffcloud.mesh import grid_cloth
from diffcloud.sim import rollout
from diffcloud.sim.build import build_system
from diffcloud.sim.handles import Handle, Handles
from diffcloud.sim.materials import preset
from diffcloud.sim.motion import Keyframe, Motion
from diffcloud.sim.still_air import still_air
from diffcloud.sim.surrounding import Surrounding
from tests.conftest import small_lift

G = 9.81
MATERIAL = preset("soft-knit")


def cloth(mesh=None, handles=(), integrator="implicit", **air):
    mesh = grid_cloth(5, 5, 0.3, 0.3) if mesh is None else mesh
    surrounding = Surrounding(air_density=0.0, self_contact=False, **air)
    return build_system(
        mesh, MATERIAL, time_step=0.01, handles=Handles(handles), surrounding=surrounding, integrator=integrator
    )


@pytest.mark.parametrize("integrator", ["implicit", "arcsim"])
def test_a_falling_cloth_accelerates_by_the_share_of_its_weight(integrator):
    """(ρ + m) z'' = -ρ g: nothing else acts."""
    run = rollout(cloth(grid_cloth(4, 4, 0.3, 0.3), integrator=integrator, added_mass=0.4 * MATERIAL.density), 20)
    np.testing.assert_allclose(run.velocities[0, -1, :, 2], -G / 1.4 * 0.2, rtol=1e-9)
    np.testing.assert_allclose(run.velocities[0, -1, :, :2], 0.0, atol=1e-9)


def test_linear_drag_ends_at_the_velocity_at_which_it_bears_the_weight():
    """c v = ρ g, and the way there is exponential with the rate c / ρ."""
    drag = 2.0 * MATERIAL.density  # [1/s] times the density: the time constant is 0.5 s
    run = rollout(cloth(linear_drag=drag), 500)
    velocity = run.velocities[0, :, :, 2].mean(-1).numpy()
    assert velocity[-1] == pytest.approx(-G / 2.0, rel=1e-3)
    assert velocity[50] == pytest.approx(-G / 2.0 * (1 - math.exp(-1.0)), rel=5e-3)


def test_a_cloth_that_hangs_still_is_as_without_air():
    """At rest only the weight counts."""
    held = tuple(Handle(node) for node in range(5))
    runs = [rollout(cloth(handles=held, linear_drag=1.2, added_mass=added), 2400) for added in (0.0, 0.15)]
    first, second = (run.positions[0, -1].numpy() for run in runs)
    assert max(run.velocities[0, -1].abs().max() for run in runs) < 1e-3
    np.testing.assert_allclose(first, second, atol=1e-4)


def test_a_cloth_swings_slower_with_air_that_moves_along():
    """The period of a small swing grows as the root of inertia over weight."""

    def period(added):
        shaken = Motion((Keyframe(0.0, (0, 0, 0)), Keyframe(0.1, (0, 0.01, 0))))
        held = tuple(Handle(node, shaken, gripper="bar") for node in range(5))
        flat = grid_cloth(5, 5, 0.3, 0.3)
        nodes = flat.nodes[:, [0, 2, 1]] * np.array([1.0, 1.0, -1.0])  # hangs down from its first row
        system = cloth(replace(flat, nodes=np.ascontiguousarray(nodes)), held, added_mass=added)
        edge = rollout(system, 400).positions[0, 30:, -5:, 1].mean(-1).numpy()
        centred = edge - edge.mean()
        crossings = np.flatnonzero((centred[:-1] < 0) & (centred[1:] >= 0))
        exact = crossings - centred[crossings] / (centred[crossings + 1] - centred[crossings])
        return 0.01 * float(np.diff(exact).mean())

    ratio = period(0.5 * MATERIAL.density) / period(0.0)
    assert ratio == pytest.approx(math.sqrt(1.5), rel=0.02)


def test_a_plate_takes_as_much_air_along_as_the_table_says():
    square, strip = still_air(grid_cloth(3, 3, 0.3, 0.3)), still_air(grid_cloth(3, 3, 0.1, 2.0))
    assert square.added_mass == pytest.approx(0.579 * math.pi / 4 * 1.2 * 0.3)
    assert strip.added_mass == pytest.approx(0.947 * math.pi / 4 * 1.2 * 0.1)
    assert 0 < square.linear_drag < 0.05


def test_a_scenario_says_which_air_it_has():
    def around(air):
        return small_lift(air=air).scene.surrounding

    assert (around("none").air_density, around("none").added_mass) == (0.0, 0.0)
    assert (around("drag").air_density, around("drag").added_mass) == (1.2, 0.0)
    assert around("still").air_density == 1.2
    assert around("still").added_mass == pytest.approx(still_air(small_lift().scene.mesh).added_mass)


def test_mass_of_cloth_and_of_air_are_apart():
    """`density` multiplies the cloth's alone, `added_mass` the air's."""
    scenario = small_lift(air="still")
    system = scenario.scene.build()[0]

    def of(**values):
        given = {name: torch.tensor([value], dtype=torch.float64) for name, value in values.items()}
        return scenario.properties(system, given)

    base, heavy, airy = of(), of(density=2.0), of(added_mass=3.0)
    air = base.node_mass - base.weight
    assert (air > 0).all()
    torch.testing.assert_close(heavy.weight, 2 * base.weight)
    torch.testing.assert_close(heavy.node_mass, 2 * base.weight + air)
    torch.testing.assert_close(airy.weight, base.weight)
    torch.testing.assert_close(airy.node_mass, base.weight + 3 * air)
