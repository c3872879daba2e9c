"""Laws of each internal energy, and the published look-up values of the material tables."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffcloud.mesh import grid_cloth
from diffcloud.sim.energies import Air, Bending, Stretching
from diffcloud.sim.energies.base import geometry
from diffcloud.sim.materials import Material, isotropic
from diffcloud.sim.properties import Properties

# ARCSim's camel-ponte-roma (Wang et al. 2011), whose sampled values are known
CAMEL = Material(
    name="camel-ponte-roma",
    density=0.284,
    stretching=np.array(
        [
            [31.146198, -12.802702, 44.028667, 31.896357],
            [78.707756, 26.754574, 268.680725, 27.743423],
            [67.368431, 77.767944, 182.273407, -14.661531],
            [113.367035, 54.802021, 175.126572, 44.657330],
            [144.294830, 111.404854, 138.422150, -29.861851],
            [143.933365, 49.654823, 191.777588, 39.491055],
        ]
    ),
    bending=1e-6
    * np.array(
        [
            [36.348366, 49.585537, 45.744080, 47.413387, 20.726685],
            [33.013252, 29.744385, 35.103642, 34.041019, 14.439938],
            [37.157593, 34.107452, 33.229435, 34.685535, 10.439938],
        ]
    ),
)
CONSTANT = isotropic("constant", density=0.2, stretching=40.0, bending=1e-4, shear=15.0)
OPTIONS = {"dtype": torch.float64, "device": torch.device("cpu")}


@pytest.fixture
def mesh():
    return grid_cloth(4, 5, 0.3, 0.4, alternate_diagonals=True)


def ones(mesh) -> Properties:
    one = torch.ones(1, dtype=torch.float64)
    return Properties(
        node_mass=torch.as_tensor(0.2 * mesh.node_area)[None],
        stretching=torch.ones(1, len(mesh.faces), dtype=torch.float64),
        bending=torch.ones(1, len(mesh.hinges.length), dtype=torch.float64),
        damping=0 * one,
        air_density=one,
        air_drag=0.3 * one,
        friction_obstacle=one,
        friction_cloth=one,
        body_mass=torch.zeros(1, 0, dtype=torch.float64),
    )


def crumpled(mesh, rng, amount=0.02, batch=2) -> torch.Tensor:
    return torch.as_tensor(mesh.nodes + amount * rng.normal(size=(batch, *mesh.nodes.shape)))


def rotation(rng) -> np.ndarray:
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


KINDS = pytest.mark.parametrize("kind", [Stretching, Bending])
MATERIALS = pytest.mark.parametrize("material", [CAMEL, CONSTANT], ids=lambda m: m.name)


def assemble(energy, blocks, node_count):
    """Element blocks -> dense [B, 3V, 3V], by the slow obvious loop."""
    dense = torch.zeros(len(blocks), 3 * node_count, 3 * node_count, dtype=blocks.dtype)
    for element, nodes in enumerate(energy.elements.nodes.tolist()):
        index = [3 * node + axis for node in nodes for axis in range(3)]
        dense[:, np.ix_(index, index)[0], np.ix_(index, index)[1]] += blocks[:, element]
    return dense


@KINDS
@MATERIALS
class TestLaws:
    def test_forces_are_minus_the_gradient_at_frozen_coefficients(self, kind, material, mesh, rng):
        energy, properties = kind.build(mesh, material, **OPTIONS), ones(mesh)
        positions = crumpled(mesh, rng).requires_grad_(True)
        at = energy.at(geometry(Stretching.build(mesh, material, **OPTIONS).elements, positions), properties)
        frozen = {"stiffness": at.stiffness.detach()} | ({"shear": at.shear.detach()} if kind is Stretching else {})
        (gradient,) = torch.autograd.grad(replace(at, **frozen).energy().sum(), positions)
        torch.testing.assert_close(at.forces(), -gradient, rtol=1e-10, atol=1e-12)

    def test_hessian_is_symmetric_positive_and_what_forces_linearise_with(self, kind, material, mesh, rng):
        energy, properties = kind.build(mesh, material, **OPTIONS), ones(mesh)
        at = energy.at(geometry(Stretching.build(mesh, material, **OPTIONS).elements, crumpled(mesh, rng)), properties)
        dense = assemble(energy, at.hessian(), len(mesh.nodes))
        torch.testing.assert_close(dense, dense.mT, rtol=1e-12, atol=1e-12)
        if material is CONSTANT:
            assert torch.linalg.eigvalsh(dense).min() >= -1e-10 * dense.abs().max()
        displacement = torch.as_tensor(rng.normal(size=(2, *mesh.nodes.shape)))
        product = (dense @ displacement.flatten(1)[..., None]).view_as(displacement)
        torch.testing.assert_close(at.forces(displacement), at.forces() - product, rtol=1e-10, atol=1e-12)

    def test_rest_shape_has_no_force_and_no_energy(self, kind, material, mesh, rng):
        energy, properties = kind.build(mesh, material, **OPTIONS), ones(mesh)
        turned = torch.as_tensor(mesh.nodes @ rotation(rng).T + rng.normal(size=3))[None]
        at = energy.at(geometry(Stretching.build(mesh, material, **OPTIONS).elements, turned), properties)
        assert at.energy().abs().max() < 1e-20
        assert at.forces().abs().max() < 1e-12

    def test_rigid_motion_turns_forces_and_keeps_energy(self, kind, material, mesh, rng):
        energy, properties = kind.build(mesh, material, **OPTIONS), ones(mesh)
        faces = Stretching.build(mesh, material, **OPTIONS).elements
        positions, turn = crumpled(mesh, rng), torch.as_tensor(rotation(rng))
        at = energy.at(geometry(faces, positions), properties)
        moved = energy.at(geometry(faces, positions @ turn.T + torch.as_tensor(rng.normal(size=3))), properties)
        torch.testing.assert_close(moved.energy(), at.energy())
        torch.testing.assert_close(moved.forces(), at.forces() @ turn.T, rtol=1e-8, atol=1e-12)

    def test_forces_have_no_resultant_and_no_moment(self, kind, material, mesh, rng):
        energy, properties = kind.build(mesh, material, **OPTIONS), ones(mesh)
        positions = crumpled(mesh, rng)
        forces = energy.at(geometry(Stretching.build(mesh, material, **OPTIONS).elements, positions), properties).forces()
        scale = forces.abs().max()
        assert forces.sum(1).abs().max() < 1e-12 * scale
        assert torch.linalg.cross(positions, forces).sum(1).abs().max() < 1e-12 * scale


def test_constant_stretching_hessian_is_the_jacobian_under_tension(mesh):
    """With constant coefficients, no shear and tension everywhere nothing is dropped: Gauss-Newton is Newton."""
    material = isotropic("no shear", density=0.2, stretching=40.0, bending=1e-4, shear=0.0)
    energy, properties = Stretching.build(mesh, material, **OPTIONS), ones(mesh)
    positions = torch.as_tensor(mesh.nodes * [1.2, 1.1, 1.0])[None]
    dense = assemble(energy, energy.at(geometry(energy.elements, positions), properties).hessian(), len(mesh.nodes))

    def forces(flat):
        return energy.at(geometry(energy.elements, flat.view_as(positions)), properties).forces().flatten()

    torch.testing.assert_close(
        dense[0], -torch.autograd.functional.jacobian(forces, positions.flatten()), rtol=1e-9, atol=1e-9
    )


@pytest.mark.parametrize(
    ("strain", "expected"),
    [
        ((0.0, 0.0, 0.0), (62.292396, 0.0, 88.057334, 63.792714)),
        ((0.06, 0.0, 0.06), (84.941187, 4.716322, 157.327509, 63.523593)),
        ((0.1, 0.02, 0.0), (119.245183, 26.00082, 354.764724, 55.777019)),
        ((-0.05, 0.01, 0.2), (287.86673, 99.309646, 383.555176, 78.98211)),
    ],
)
def test_stretching_table_gives_the_reference_simulators_values(strain, expected, mesh):
    e00, e01, e11 = (torch.tensor([value], dtype=torch.float64) for value in strain)
    energy = Stretching.build(mesh, CAMEL, **OPTIONS)
    k0, k1, same, k2, k3 = energy.coefficients(torch.stack([e00, e11], -1), e01)[0].tolist()
    assert (k0, k1, k2, k3) == pytest.approx(expected, rel=1e-6, abs=1e-6)
    assert same == k1
    sheared = energy.coefficients(torch.stack([e00, e11], -1), -e01)[0]
    assert sheared.tolist() == pytest.approx([k0, k1, k1, k2, k3])


def test_stretching_table_is_clamped_at_its_border(mesh):
    energy = Stretching.build(mesh, CAMEL, **OPTIONS)
    far = energy.coefficients(torch.tensor([[9.0, 9.0]], dtype=torch.float64), torch.tensor([9.0], dtype=torch.float64))
    edge = energy.coefficients(torch.tensor([[0.72, 0.72]], dtype=torch.float64), torch.tensor([0.97], dtype=torch.float64))
    torch.testing.assert_close(far, edge)
    assert (far >= 0).all()


@pytest.mark.parametrize(
    ("curvature", "direction", "expected"),
    [
        (0.0, 0.0, 36.348366),
        (0.5, 0.0, 46.276244),
        (1.0, np.pi / 4, 35.103642),
        (1.5, np.pi / 2, 28.624136),
        (-1.0, np.pi / 4, 33.013252),
        (0.8, -np.pi / 3, 33.046229),
        (3.0, 2.8, 19.768623),
    ],
)
def test_bending_table_gives_the_reference_simulators_values(curvature, direction, expected, mesh):
    from dataclasses import replace

    from diffcloud.sim.energies.bending import _rows_at

    row = _rows_at(CAMEL.bending, np.array([[direction, direction]]))
    one = torch.ones(1, dtype=torch.float64)
    # chosen so that the curvature coordinate 0.05 θ l/(a0+a1) is `curvature` at θ = 1
    bending = replace(
        Bending.build(mesh, CAMEL, **OPTIONS), table=torch.as_tensor(row), stiffness=one, curvature=2.5 * curvature * one
    )
    properties = ones(mesh)
    from dataclasses import replace as with_changes

    properties = with_changes(properties, bending=one[None])
    found = bending._coefficient(one[None], properties)
    assert float(found) * 1e6 == pytest.approx(expected, rel=1e-6)


def test_bent_cylinder_has_the_energy_of_a_plate(mesh):
    """B = k_b/4 for a cylinder about a grid axis: the derivation in materials.py, by numbers."""
    radius, table_entry = 5.0, 3e-4
    fine = grid_cloth(5, 41, 0.1, 1.0)
    material = Material("m", 0.2, CONSTANT.stretching, np.full((3, 5), table_entry))
    x = fine.nodes[:, 0]
    rolled = np.column_stack([radius * np.sin(x / radius), fine.nodes[:, 1], radius * (1 - np.cos(x / radius))])
    at = geometry(Stretching.build(fine, material, **OPTIONS).elements, torch.as_tensor(rolled)[None])
    energy = float(Bending.build(fine, material, **OPTIONS).at(at, ones(fine)).energy())
    # 39 inner edges of 40 cells bend
    assert energy == pytest.approx(0.5 * table_entry / 4 / radius**2 * 0.1 * (39 / 40), rel=1e-4)


def test_air_pushes_against_the_motion_and_as_formulas_say(mesh):
    properties = ones(mesh)
    stretching = Stretching.build(mesh, CONSTANT, **OPTIONS)
    air = Air(stretching.elements, stretching.area, torch.tensor([0.0, 0.0, 0.5], dtype=torch.float64))
    at = geometry(stretching.elements, torch.as_tensor(mesh.nodes)[None])
    velocities = torch.zeros(1, len(mesh.nodes), 3, dtype=torch.float64)
    velocities[..., 0], velocities[..., 2] = 2.0, -1.0
    total = air.forces(at, velocities, properties).sum(1)[0]
    area = 0.3 * 0.4
    assert total.tolist() == pytest.approx([-0.3 * area * 2.0, 0.0, 1.0 * area * 1.5 * 1.5])


class TestShaped:
    """Hinges at rest as the mesh stands."""

    @pytest.fixture
    def bent(self, mesh, rng):
        return replace(mesh, nodes=mesh.nodes + 0.02 * rng.normal(size=mesh.nodes.shape))

    def test_no_force_as_it_stands_wherever_it_stands(self, bent, rng):
        energy, faces = (
            Bending.build(bent, CAMEL, **OPTIONS, shaped=True),
            Stretching.build(bent, CAMEL, **OPTIONS).elements,
        )
        turned = torch.as_tensor(bent.nodes @ rotation(rng).T + rng.normal(size=3))[None]
        at = energy.at(geometry(faces, turned), ones(bent))
        flat = Bending.build(bent, CAMEL, **OPTIONS).at(geometry(faces, turned), ones(bent))
        assert flat.forces().abs().max() > 1e-6
        assert at.forces().abs().max() < 1e-9 * flat.forces().abs().max()

    def test_angles_count_from_rest(self, mesh, bent, rng):
        faces = Stretching.build(bent, CONSTANT, **OPTIONS).elements
        shaped, flat = (Bending.build(bent, CONSTANT, **OPTIONS, shaped=shaped) for shaped in (True, False))
        moved = geometry(faces, crumpled(mesh, rng))
        rest = flat.at(geometry(faces, torch.as_tensor(bent.nodes)[None]), ones(bent)).angle
        torch.testing.assert_close(shaped.at(moved, ones(bent)).angle, flat.at(moved, ones(bent)).angle - rest)

    def test_a_fold_beyond_a_half_turn_goes_the_short_way(self):
        """From folded up by 175 degrees to folded down by 175: 10 degrees away, not 350."""
        one = grid_cloth(2, 2, 1.0, 1.0)
        assert len(one.hinges.length) == 1

        def folded(degrees: float) -> np.ndarray:
            nodes = one.nodes.copy()
            first, second, tip, _ = one.hinges.nodes[0]
            axis = (one.nodes[second] - one.nodes[first]) / np.linalg.norm(one.nodes[second] - one.nodes[first])
            arm, turn = one.nodes[tip] - one.nodes[first], np.deg2rad(degrees)
            across = arm - axis * (axis @ arm)
            nodes[tip] += across * (np.cos(turn) - 1) + np.cross(axis, across) * np.sin(turn)
            return nodes

        up = replace(one, nodes=folded(175.0))
        energy = Bending.build(up, CONSTANT, **OPTIONS, shaped=True)
        down = geometry(Stretching.build(up, CONSTANT, **OPTIONS).elements, torch.as_tensor(folded(-175.0))[None])
        assert float(energy.at(down, ones(up)).angle.abs()) == pytest.approx(np.deg2rad(10.0))
