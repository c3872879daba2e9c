"""Physics with known answers (closed forms, and the heavy elastica solved to 1e-9)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffcloud.mesh import grid_cloth
from diffcloud.scene.scenarios import built_in, grid_scenario
from diffcloud.sim import init, rollout
from diffcloud.sim.build import build_system
from diffcloud.sim.handles import Handle, Handles
from diffcloud.sim.materials import isotropic
from diffcloud.sim.properties import one_set
from diffcloud.sim.surrounding import Surrounding
from tests.sim.twins.forces import Forces

DENSITY = 0.2


def relaxed(system, steps):
    """Run until numerical damping has brought the cloth to rest; [V, 3] and the last speed."""
    with torch.no_grad():
        positions = rollout(system, steps).positions[0].numpy()
    return positions[-1], float(np.abs(positions[-1] - positions[-2]).max() / system.time_step)


@pytest.mark.parametrize("poisson", [0.0, 0.3])
def test_a_sheared_panel_that_wrinkles_carries_diagonal_tension(poisson):
    """Wagner 1929: sheared by γ between two beams it pulls at 45° with k γ/2 (k: of a strip with free sides), that is with
    k γ/4 along the beams and as much across, which draws them together. A plate: k γ/(2 (1 + ν)) along and none across."""
    stiffness, gamma, side = 60.0, 0.1, 0.3
    mesh = grid_cloth(7, 7, side, side)
    deformation = np.array([[1.0, gamma], [0.0, np.sqrt(1 - gamma**2)]])  # of strain γ/2 in shear, and none along the sides
    at = np.column_stack([mesh.nodes[:, :2] @ deformation.T, mesh.nodes[:, 2]])
    sheet = replace(isotropic("m", density=DENSITY, stretching=stiffness, bending=1e-5, poisson=poisson), compression=0.0)
    panel = Forces(mesh, sheet)

    def on_the_beam(*names: str) -> np.ndarray:  # [N/m] along it and across, in the material's axes
        forces = sum(panel.force(name, panel.motion(at)) for name in names).reshape(7, 7, 3)
        np.testing.assert_allclose(forces[1:-1, 1:-1], 0.0, atol=1e-12)
        return np.linalg.solve(deformation, -forces[-1, :, :2].sum(0) / side)

    # to 4 %: less compression than a strain of 0.0005 is resisted in full
    assert on_the_beam("stretching") == pytest.approx([stiffness * gamma / (2 * (1 + poisson)), 0.0], abs=1e-9)
    assert on_the_beam("stretching", "wrinkling") == pytest.approx([stiffness * gamma / 4] * 2, rel=0.04)


def test_uniaxial_patch_pulls_with_stiffness_times_strain():
    """A uniformly stretched patch: force per width K E (1 + ε) exactly, inner nodes in balance."""
    stiffness, epsilon = 80.0, 0.03
    mesh = grid_cloth(6, 5, 0.3, 0.2)
    material = isotropic("m", density=DENSITY, stretching=stiffness, bending=1e-5)
    patch = Forces(mesh, material)
    forces = patch.force("stretching", patch.motion(mesh.nodes * [1 + epsilon, 1.0, 1.0])).reshape(6, 5, 3)
    strain = epsilon + epsilon**2 / 2  # Green
    expected = stiffness * strain * (1 + epsilon) * 0.3
    assert forces[:, 0, 0].sum() == pytest.approx(expected, rel=1e-12)
    assert forces[:, -1, 0].sum() == pytest.approx(-expected, rel=1e-12)
    np.testing.assert_allclose(forces[:, 1:-1], 0.0, atol=1e-12)


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.49])
def test_an_isotropic_sheet_contracts_and_shears_as_it_should(poisson):
    """A pulled strip that contracts by ν ε has free sides and pulls with E h ε; a sheared one resists with
    E h / (2 (1 + ν)) per angle."""
    stiffness, epsilon = 80.0, 1e-6
    mesh = grid_cloth(5, 6, 0.2, 0.3)
    material = isotropic("m", density=DENSITY, stretching=stiffness, bending=1e-5, poisson=poisson)
    assert material.resting_stretching_stiffness == pytest.approx(stiffness)
    assert material.resting_poisson_ratio == pytest.approx(poisson)
    patch = Forces(mesh, material)

    def pull(gradient: list[list[float]]) -> np.ndarray:
        moved = mesh.nodes.copy()
        moved[:, :2] = mesh.nodes[:, :2] @ (np.eye(2) + epsilon * np.array(gradient)).T
        return patch.force("stretching", patch.motion(moved)).reshape(5, 6, 3) / epsilon

    stretched = pull([[1.0, 0.0], [0.0, -poisson]])
    assert stretched[:, 0, 0].sum() == pytest.approx(stiffness * 0.2, rel=1e-4)
    np.testing.assert_allclose(stretched[0, :, 1].sum(), 0.0, atol=1e-4 * stiffness * 0.3)
    sheared = pull([[0.0, 1.0], [0.0, 0.0]])
    assert sheared[0, :, 0].sum() == pytest.approx(stiffness / (2 * (1 + poisson)) * 0.3, rel=1e-4)
    assert material.resting_shear_stiffness == pytest.approx(stiffness / (2 * (1 + poisson)))


def hanging_elongation(rows, stiffness=50.0):
    length, width = 0.5, 0.1
    mesh = grid_cloth(rows, 3, length, width)
    upright = np.column_stack([mesh.nodes[:, 0], np.zeros(len(mesh.nodes)), mesh.nodes[:, 1]])
    mesh = replace(mesh, nodes=upright)
    top = range(len(mesh.nodes) - 3, len(mesh.nodes))
    system = build_system(
        mesh,
        isotropic("m", density=DENSITY, stretching=stiffness, bending=1e-6),
        integrator="arcsim",
        time_step=0.02,
        handles=Handles(tuple(Handle(node) for node in top), hard=True),
        surrounding=Surrounding(air_density=0.0),
    )
    positions, speed = relaxed(system, 400)
    assert speed < 1e-5
    return -(positions[:3, 2].mean() - mesh.nodes[:3, 2].mean())


def test_hanging_strip_elongates_by_half_its_weight():
    """Tip elongation σ g L²/(2 K) for small strain; exactly, K E (1 + ε) = σ g s at the height s over the tip."""
    length, stiffness = 0.5, 50.0
    heights = np.linspace(0, length, 2001)
    strain = np.zeros_like(heights)
    for _ in range(50):
        strain = DENSITY * 9.81 * heights / stiffness / ((1 + strain / 2) * (1 + strain))
    exact = float(np.trapezoid(strain, heights))
    linear = DENSITY * 9.81 * length**2 / (2 * stiffness)
    assert exact == pytest.approx(linear, rel=0.03)
    errors = [abs(hanging_elongation(rows) / exact - 1) for rows in (5, 9, 17)]
    print(f"relative errors {errors}")
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 1e-3


ELASTICA = {
    0.5: (0.06231, 0.99778),
    2: (0.23851, 0.96689),
    5: (0.49590, 0.84666),
    10: (0.70020, 0.65635),
    50: (0.90791, 0.24501),
}
"""Γ = σ g L³/B -> (drop / L, reach / L) of the tip of a clamped heavy strip."""


def heavy_strip(gamma, cells, length=0.1, bending=1e-4):
    # the clamp ends in the middle of a cell: the hinge at the clamp bends over half a cell on either side
    side = length / (cells + 0.5)
    mesh = grid_cloth(3, cells + 2, 2 * side, side * (cells + 1), through=1)
    clamped = [row * (cells + 2) + column for row in range(3) for column in (0, 1)]
    gravity = gamma * bending / (DENSITY * length**3)
    system = build_system(
        mesh,
        isotropic("m", density=DENSITY, stretching=2000.0, shear=500.0, bending=bending),
        integrator="arcsim",
        time_step=0.02,
        handles=Handles(tuple(Handle(node) for node in clamped), hard=True),
        surrounding=Surrounding(gravity=(0.0, 0.0, -gravity), air_density=0.0),
    )
    positions, speed = relaxed(system, 500)
    assert speed < 1e-3 * length / 0.02
    tip = positions.reshape(3, cells + 2, 3)[:, -1].mean(axis=0)
    root = mesh.nodes.reshape(3, cells + 2, 3)[:, 1].mean(axis=0)
    return -tip[2] / length, (tip[0] - root[0] + side / 2) / length


@pytest.mark.parametrize("gamma", ELASTICA)
def test_heavy_elastica_under_mesh_refinement(gamma):
    """With B = k_b/5 (materials.py) the clamped strip converges to the elastica: errors halve with the cells."""
    drop, reach = ELASTICA[gamma]
    errors = []
    for cells in (8, 16, 32):
        found = heavy_strip(gamma, cells)
        errors.append(max(abs(found[0] - drop), abs(found[1] - reach)))
    print(f"Γ = {gamma}: errors {', '.join(f'{error:.4f}' for error in errors)} of the length")
    assert errors[0] > 1.5 * errors[1] > 1.5**2 * errors[2]
    assert errors[2] < 0.015


@pytest.mark.parametrize("factor", [0.25, 3.0, 10.0])
def test_scale_degeneracy(factor):
    """Density, stretching, bending, damping (and contact stiffness) times one factor: the same motion.

    With hard handles and no air. So clouds identify ratios only. Mass alone does move the cloth.
    """
    options = built_in("lift").model_copy(update={"nodes": (5, 5), "frames": 10, "air_density": 0.0, "gap_m": 0.003})

    def run(parameters, contact):
        scenario = grid_scenario(options.model_copy(update={"contact_stiffness": 1e5 * contact}))
        system, _ = scenario.scene.build()
        values = one_set(parameters)
        return rollout(system, scenario.steps, properties=scenario.properties(system, values)).positions

    with torch.no_grad():
        base = run({"stretching": 1.0}, 1.0)
        # damping is stiffness-proportional: its force scales with the stiffness by itself
        scaled = run({"stretching": factor, "bending": factor, "density": factor}, factor)
        heavier = run({"density": 1.5}, 1.0)
    assert (scaled - base).abs().max() < 1e-9
    assert (heavier - base).abs().max() > 1e-3


def test_pendulum_period_of_a_stiff_sheet():
    """A stiff sheet hung from its upper edge swings as a physical pendulum: T = 2π √(2 L / 3 g)."""
    length = 0.3
    mesh = grid_cloth(4, 4, length, length)
    angle = 0.1
    upright = np.column_stack(
        [mesh.nodes[:, 0], np.sin(angle) * (length / 2 - mesh.nodes[:, 1]), np.cos(angle) * (mesh.nodes[:, 1] - length / 2)]
    )
    mesh = replace(mesh, nodes=upright)
    system = build_system(
        mesh,
        isotropic("m", density=DENSITY, stretching=2000.0, bending=0.5),
        integrator="arcsim",
        time_step=0.001,
        handles=Handles(tuple(Handle(node) for node in range(12, 16)), hard=True),
        surrounding=Surrounding(air_density=0.0),
    )
    with torch.no_grad():
        swing = rollout(system, 800, state=init(system)).positions[0, :, :4, 1].mean(1).numpy()
    crossings = np.flatnonzero(np.diff(np.sign(swing)) != 0)
    # a quarter of a period to the first crossing, half a period to the next; lumped masses of 4 rows of nodes
    rows = np.arange(4) / 3
    weight = np.array([0.5, 1, 1, 0.5])
    inertia, moment = (weight * (rows * length) ** 2).sum(), (weight * rows * length).sum()
    period = 2 * np.pi * np.sqrt(inertia / (9.81 * moment))
    assert 2 * (crossings[1] - crossings[0]) * system.time_step == pytest.approx(period, rel=0.02)


@pytest.mark.parametrize("integrator", ["implicit", "arcsim"])
def test_damping_takes_nothing_from_a_sheet_that_swings_as_a_whole(integrator):
    """It multiplies rates of strain, not the tension: the swing of a stiff sheet is as high with it as without."""
    length, angle = 0.3, 0.1
    mesh = grid_cloth(4, 4, length, length)
    down = length / 2 - mesh.nodes[:, 1]
    mesh = replace(mesh, nodes=np.column_stack([mesh.nodes[:, 0], np.sin(angle) * down, -np.cos(angle) * down]))

    def lowest(damping):
        system = build_system(
            mesh,
            isotropic("m", density=DENSITY, stretching=2000.0, bending=0.5, damping=damping),
            integrator=integrator,
            time_step=0.002,
            handles=Handles(tuple(Handle(node) for node in range(12, 16)), hard=True),
            surrounding=Surrounding(air_density=0.0),
        )
        with torch.no_grad():
            return float(rollout(system, 300).positions[0, :, :4, 1].mean(1).min())

    assert lowest(0.05) == pytest.approx(lowest(0.0), rel=0.01)
