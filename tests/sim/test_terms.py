"""Each force: kernels against plain twins, laws of the energies, published look-up values of the material tables."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from diffcloud.arcsim.terms import TERMS
from diffcloud.errors import SceneError
from diffcloud.mesh import SurfaceMesh, grid_cloth
from diffcloud.sim.compiled.data import Motion, Parameters
from diffcloud.sim.compiled.trace import Graph
from diffcloud.sim.materials import TABLE_ENTRY_TO_STRETCHING, Material, isotropic
from diffcloud.sim.surrounding import ContactSettings, Surrounding
from diffcloud.sim.terms.stretching import _sampled
from tests.sim.twins import terms as twins
from tests.sim.twins.forces import Forces, term_of, twin_force
from tests.sim.twins.terms import coefficients, sampled

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
    compression=0.1,
)
CONSTANT = replace(
    isotropic("constant", density=0.2, stretching=40.0, bending=1e-4, poisson=0.2, shear=7.5), compression=0.1
)
TABLE = SurfaceMesh(np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0.3], [-1, 1, 0.3]]), np.array([[0, 1, 2], [0, 2, 3]]))
AROUND = {
    name: Surrounding(
        obstacles=(TABLE,),
        wind=(0.3, -0.2, 0.5),
        air_drag=0.4,
        lagged_air=name == "lagged",
        contact=ContactSettings(1e3, 0.15, 0.015),
    )
    for name in ("damped", "lagged")
}


@pytest.fixture
def mesh():
    return grid_cloth(4, 5, 0.3, 0.4, through=1)


def crumpled(mesh, rng, amount=0.02) -> np.ndarray:
    return mesh.nodes + amount * rng.normal(size=mesh.nodes.shape)


def rotation(rng) -> np.ndarray:
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def states(mesh, rng) -> dict[str, np.ndarray]:
    """Positions at which formulas are at ease, and others at which they are not."""
    collapsed, inverted = crumpled(mesh, rng), crumpled(mesh, rng)
    flat = mesh.nodes * [1.01, 0.99, 1.0]  # a strain between the samples of the material, where its slope is continuous
    collapsed[3] = collapsed[4]
    collapsed[7] = collapsed[6]
    inverted[mesh.faces[5]] = inverted[mesh.faces[5]][[1, 0, 2]]
    return {
        "crumpled": crumpled(mesh, rng),
        "torn": crumpled(mesh, rng, 0.3),
        "collapsed": collapsed,
        "inverted": inverted,
        "flat": flat,
        "folded": np.column_stack([np.minimum(flat[:, 0], 0.2 - flat[:, 0]), flat[:, 1], 1e-3 * flat[:, 1]]),
    }


@pytest.mark.parametrize("around", AROUND)
@pytest.mark.parametrize("name", [term.name for term in TERMS])
def test_what_velocities_at_the_end_do_is_symmetric_and_does_not_drive(name, around, mesh, rng):
    """So that the linearised step's matrix is symmetric and positive definite."""
    forces = Forces(mesh, CAMEL, AROUND[around], rng=rng)
    moves = [0.5 * rng.normal(size=mesh.nodes.shape) for _ in range(3)]
    motion = forces.motion(crumpled(mesh, rng), *moves)
    u, w = (rng.normal(size=mesh.nodes.shape) for _ in range(2))

    def pulled(adjoint: np.ndarray) -> np.ndarray:
        return forces.reverse(name, motion, adjoint)[1].after

    assert (pulled(u) * w).sum() == pytest.approx((pulled(w) * u).sum(), rel=1e-9, abs=1e-12)
    assert (pulled(u) * u).sum() <= 1e-12


@pytest.mark.parametrize("around", AROUND)
@pytest.mark.parametrize("state", ["crumpled", "torn", "collapsed", "inverted", "flat", "folded"])
@pytest.mark.parametrize("name", [term.name for term in TERMS])
def test_kernels_are_as_their_twins_say(name, state, around, mesh, rng):
    """Forces to 1e-12, derivatives to 1e-9 of the largest; also at nonzero rest angles."""
    bent = replace(mesh, nodes=crumpled(mesh, rng, 0.01))
    forces = Forces(bent, CAMEL, AROUND[around], shaped=True, rng=rng)
    moves = [0.5 * rng.normal(size=mesh.nodes.shape) for _ in range(3)]
    motion = forces.motion(states(mesh, rng)[state], *moves)
    extra, twin = sampled(name, _sampled(CAMEL.stretching)), getattr(twins, name)
    inputs = {
        key: torch.as_tensor(value).requires_grad_()
        for key, value in (*motion._asdict().items(), *forces.parameters._asdict().items())
    }
    found, expected = forces.force(name, motion), twin_force(forces, name, twin, inputs, extra)
    assert state != "crumpled" or np.abs(found).max() > 0, "The force acts on no node: give it settings in AROUND."
    scale = max(np.abs(found).max(), 1e-9)
    np.testing.assert_allclose(found, expected.detach().numpy(), rtol=0, atol=1e-12 * scale)

    adjoint = rng.normal(size=mesh.nodes.shape)
    gradients, slopes = forces.reverse(name, motion, adjoint)
    derived = torch.autograd.grad(
        (expected * torch.as_tensor(adjoint)).sum(), list(inputs.values()), materialize_grads=True
    )
    for key, value in zip(inputs, derived, strict=True):
        own = getattr(slopes, key) if key in Motion._fields else getattr(gradients, key)
        scale = max(np.abs(value.numpy()).max(initial=0), 1e-9)
        np.testing.assert_allclose(own, value.numpy(), rtol=0, atol=1e-9 * scale, err_msg=key)

    rates = Parameters(*(rng.normal(size=(2, *field.shape)) for field in forces.parameters))
    changes = Motion(*(rng.normal(size=(2, *field.shape)) for field in motion))
    along = forces.tangent(name, motion, rates, changes)
    for k in range(2):
        weighted = sum((getattr(gradients, key) * getattr(rates, key)[k]).sum() for key in Parameters._fields)
        weighted += sum((getattr(slopes, key) * getattr(changes, key)[k]).sum() for key in Motion._fields)
        assert (along[k] * adjoint).sum() == pytest.approx(weighted, rel=1e-9, abs=1e-9 * max(1.0, np.abs(along[k]).max()))


@pytest.mark.parametrize("name", [term.name for term in TERMS])
def test_a_force_pushes_no_more_than_it_says(name, mesh, rng):
    """A force with settings of its own; the check of plausible motions knows what the others can do."""
    forces = Forces(mesh, CAMEL, AROUND["damped"], rng=rng)
    most = term_of(name).push(forces.system.setup)
    if name in AROUND["damped"].forces and term_of(name).energy is None:
        found = forces.force(name, forces.motion(mesh.nodes))
        assert np.linalg.norm(found, axis=1).sum() <= most * (1 + 1e-12), "Give the Term a `push` that is no less."
    else:
        assert most == 0


@pytest.mark.parametrize("name", [term.name for term in TERMS])
def test_matrices_are_the_derivatives_of_the_forces(name, mesh, rng):
    """`assemble` by displacement and velocity, `jacobian` by positions too: against reverse mode, row by row."""
    forces = Forces(mesh, CAMEL, AROUND["damped"], rng=rng)
    motion = forces.motion(crumpled(mesh, rng), *(0.5 * rng.normal(size=mesh.nodes.shape) for _ in range(3)))
    displaced, moved = 0.3, 0.7
    rows = {field: [] for field in Motion._fields}
    for row in np.eye(3 * len(mesh.nodes)):
        _, slopes = forces.reverse(name, motion, row.reshape(-1, 3))
        for field in Motion._fields:
            rows[field].append(getattr(slopes, field).ravel())
    by = {field: np.array(found) for field, found in rows.items()}
    assembled = -displaced * by["displacement"] - moved * by["after"]
    scale = max(np.abs(assembled).max(), 1e-9)
    np.testing.assert_allclose(forces.stiffness(name, motion, displaced, moved), assembled, rtol=0, atol=1e-12 * scale)
    whole = assembled - moved * by["before"] - moved * forces.timing.time_step * by["positions"]
    scale = max(np.abs(whole).max(), 1e-9)
    np.testing.assert_allclose(forces.jacobian(name, motion, displaced, moved), whole, rtol=0, atol=1e-12 * scale)


def test_a_formula_that_asks_for_the_truth_of_a_number_is_refused():
    with pytest.raises(TypeError, match="`where` instead of `if`"):
        bool(Graph().constant(1.0))


def test_settings_of_an_unknown_force_are_refused(mesh):
    with pytest.raises(SceneError, match="no_such_force"):
        Forces(mesh, CAMEL, Surrounding(forces={"no_such_force": {}}))


KINDS = pytest.mark.parametrize("name", ["stretching", "wrinkling", "bending"])
MATERIALS = pytest.mark.parametrize("material", [CAMEL, CONSTANT], ids=lambda m: m.name)


@KINDS
class TestEnergies:
    def test_forces_are_minus_the_gradient_where_coefficients_are_constant(self, name, mesh, rng):
        forces, at = Forces(mesh, CONSTANT, rng=rng), crumpled(mesh, rng)
        found, step = forces.force(name, forces.motion(at)), 1e-6
        for node, axis in ((0, 2), (7, 0), (12, 1), (19, 2)):
            change = np.zeros_like(at)
            change[node, axis] = step
            slope = forces.energy(name, forces.motion(at + change)) - forces.energy(name, forces.motion(at - change))
            assert found[node, axis] == pytest.approx(-slope / (2 * step), rel=1e-6, abs=1e-8)

    def test_stiffness_is_symmetric_and_positive_where_coefficients_are_constant(self, name, mesh, rng):
        forces = Forces(mesh, CONSTANT, rng=rng)
        motion = forces.motion(crumpled(mesh, rng))
        step = forces.timing.ahead
        dense = forces.stiffness(name, motion, step, 1.0)
        if name == "wrinkling":  # takes off a part of stretching's
            assert np.trace(dense) < 0
            dense = dense + forces.stiffness("stretching", motion, step, 1.0)
        assert np.abs(dense - dense.T).max() <= 1e-12 * np.abs(dense).max()
        assert np.linalg.eigvalsh(dense).min() >= -1e-10 * np.abs(dense).max()

    @MATERIALS
    def test_rest_shape_has_no_force_and_no_energy(self, name, material, mesh, rng):
        forces = Forces(mesh, material)
        motion = forces.motion(mesh.nodes @ rotation(rng).T + rng.normal(size=3))
        assert abs(forces.energy(name, motion)) < 1e-20
        assert np.abs(forces.force(name, motion)).max() < 1e-12

    @MATERIALS
    def test_rigid_motion_turns_forces_and_keeps_energy(self, name, material, mesh, rng):
        forces, turn, at = Forces(mesh, material), rotation(rng), crumpled(mesh, rng)
        motion, moved = forces.motion(at), forces.motion(at @ turn.T + rng.normal(size=3))
        assert forces.energy(name, moved) == pytest.approx(forces.energy(name, motion))
        np.testing.assert_allclose(forces.force(name, moved), forces.force(name, motion) @ turn.T, rtol=1e-8, atol=1e-12)

    @MATERIALS
    def test_forces_have_no_resultant_and_no_moment(self, name, material, mesh, rng):
        forces, at = Forces(mesh, material), crumpled(mesh, rng)
        found = forces.force(name, forces.motion(at))
        scale = np.abs(found).max()
        assert np.abs(found.sum(0)).max() < 1e-12 * scale
        assert np.abs(np.cross(at, found).sum(0)).max() < 1e-12 * scale


class TestWrinkling:
    """What of the energy of compression is left: the sum of both terms against stretching alone."""

    SHEETS = pytest.mark.parametrize(
        "sheet",
        [CONSTANT, replace(CONSTANT, stretching=CONSTANT.stretching * [1, 0, 3, 1])],
        ids=["isotropic", "orthotropic"],
    )

    FABRICS = pytest.mark.parametrize(
        "fabric",
        [
            replace(CONSTANT, stretching=CONSTANT.stretching * [1, 0, 1, 1]),
            replace(CONSTANT, stretching=CONSTANT.stretching * [1, 2, 1, 1]),
            replace(CONSTANT, stretching=CONSTANT.stretching * [1, 2, 3, 1]),
        ],
        ids=["little shear", "coupled", "orthotropic"],
    )

    @staticmethod
    def stored(sheet: Material, mesh, at: np.ndarray) -> tuple[float, float]:
        """(energy of both terms, of stretching alone)"""
        forces = Forces(mesh, sheet)
        alone = forces.energy("stretching", forces.motion(at))
        return alone + forces.energy("wrinkling", forces.motion(at)), alone

    @SHEETS
    @pytest.mark.parametrize(("along", "across"), [(1.1, 1.0), (1.0, 1.2), (1.1, 1.05)])
    def test_nothing_in_a_sheet_that_is_taut(self, sheet, along, across, mesh):
        both, alone = self.stored(sheet, mesh, mesh.nodes * [along, across, 1.0])
        assert both == alone > 0

    @SHEETS
    @pytest.mark.parametrize(("along", "across"), [(0.9, 1.0), (1.0, 0.8), (0.9, 0.95)])
    def test_a_tenth_of_the_energy_in_a_sheet_that_is_compressed(self, sheet, along, across, mesh):
        both, alone = self.stored(sheet, mesh, mesh.nodes * [along, across, 1.0])
        assert 0.1 * alone < both < 0.14 * alone  # the rest is what easing takes

    @pytest.mark.parametrize("degrees", [0.0, 20.0, 45.0, 77.0])
    def test_a_sheet_pulled_along_and_pressed_across_keeps_the_pull_in_every_direction(self, degrees, mesh):
        """Isotropic without coupling: the principal strains have energies of their own."""
        sheet = replace(isotropic("sheet", density=0.2, stretching=40.0, bending=1e-4), compression=0.1)
        angle = np.deg2rad(degrees)
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        pulled = np.diag([1.1, 0.9, 1.0])
        both, alone = self.stored(sheet, mesh, mesh.nodes @ turn @ pulled @ turn.T)
        area, pull, press = 0.3 * 0.4, 0.5 * (1.1**2 - 1), 0.5 * (0.9**2 - 1)
        assert alone == pytest.approx(0.5 * 40 * area * (pull**2 + press**2))
        assert both == pytest.approx(0.5 * 40 * area * (pull**2 + 0.1 * press**2), rel=0.02)

    @FABRICS
    @pytest.mark.parametrize("degrees", [10.0, 45.0, 77.0])
    def test_a_strip_pulled_in_any_direction_and_free_across_pulls_as_without(self, fabric, degrees, mesh):
        """One tension is no compression, however much the strip narrows and shears."""
        (k0, k1, k2, k3), (u, v) = _constants(fabric), (np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees)))
        along_u, along_v = np.linalg.solve([[k0, k1], [k1, k2]], [u * u, v * v])
        strain = 2.0 * np.array([[along_u, u * v / k3], [u * v / k3, along_v]])  # of 2 N/m
        assert np.linalg.eigvalsh(strain).min() < -1e-3
        forces, at = Forces(mesh, fabric), strained(mesh, strain)
        found, alone = (np.abs(forces.force(name, forces.motion(at))).max() for name in ("wrinkling", "stretching"))
        assert found < 1e-12 < 0.01 < alone

    def test_damping_is_the_same_part_of_that_of_a_sheet_that_resists_in_whatever_state(self, mesh, rng):
        """So that it does not jump where a face becomes slack."""
        forces, rest = Forces(mesh, CONSTANT), np.zeros_like(mesh.nodes)
        for name, at in states(mesh, rng).items():
            moved = 0.01 * rng.normal(size=at.shape)
            damping, alone = (
                forces.force(kind, forces.motion(at, rest, rest, moved)) - forces.force(kind, forces.motion(at))
                for kind in ("wrinkling", "stretching")
            )
            np.testing.assert_allclose(damping, -0.9 * alone, rtol=0, atol=1e-8 * np.abs(alone).max(), err_msg=name)

    def test_derivatives_are_of_one_size_where_wrinkles_begin(self, mesh, rng):
        """How much energy is lost must not come from the difference of what is stored and what is kept."""
        (_, k1, k2, _), begins = _constants(CONSTANT), 5e-4
        forces, moved = Forces(mesh, CONSTANT), 0.01 * rng.normal(size=mesh.nodes.shape)
        adjoint = rng.normal(size=mesh.nodes.shape)

        def largest(beyond: float) -> float:
            narrowed = k1 / k2 * (0.1 + begins) + begins
            at = strained(mesh, np.diag([0.1, -narrowed - beyond]))
            motion = forces.motion(at, np.zeros_like(at), moved / forces.timing.ahead, moved)
            return np.abs(forces.reverse("wrinkling", motion, adjoint)[1].positions).max()

        assert largest(-1e-5) < 1e-12 * largest(1e-5)
        assert max(largest(10.0**-power) for power in range(6, 15)) < 2 * largest(1e-5)

    @FABRICS
    def test_what_is_stored_is_the_least_over_all_slack_that_wrinkles_take_up(self, fabric, mesh, rng):
        """Against a minimum over positive A of the energy at the strain and A, found by brute force."""
        (k0, k1, k2, k3), begins, area = _constants(fabric), 5e-4, 0.3 * 0.4

        def whole(tensor: np.ndarray) -> float:
            return (
                0.5 * (k0 * tensor[0, 0] ** 2 + k2 * tensor[1, 1] ** 2)
                + k1 * tensor[0, 0] * tensor[1, 1]
                + k3 * tensor[0, 1] ** 2
            )

        wrinkled = 0
        for _ in range(40):
            strain = 0.1 * rng.normal(size=(2, 2))
            strain = 0.5 * (strain + strain.T)
            shifted = strain + begins * np.eye(2)

            def slackened(root: np.ndarray, shifted: np.ndarray = shifted) -> float:
                lower = np.array([[root[0], 0.0], [root[1], root[2]]])
                return whole(shifted + lower @ lower.T)

            starts = [0.3 * rng.normal(size=3) for _ in range(4)]
            kept = min(minimize(slackened, start, method="BFGS", options={"gtol": 1e-10}).fun for start in starts)
            lost, scale = whole(shifted) - kept, 0.25 * begins**2 * (k0 + k2)
            if lost > scale < kept:  # else easing counts
                wrinkled += 1
                eased = kept + scale * ((lost / scale) ** 0.5 - 1 / 3)  # a little compression is always resisted
                both, alone = self.stored(replace(fabric, compression=0.0), mesh, strained(mesh, strain))
                assert (alone - both) / area == pytest.approx(whole(shifted) - eased, rel=1e-5)
        assert wrinkled > 10

    @pytest.mark.parametrize("compression", [-0.1, 1.5, float("nan")])
    def test_compression_outside_of_0_to_1_is_refused(self, compression):
        with pytest.raises(SceneError, match="compression must be between 0 and 1"):
            replace(CONSTANT, compression=compression)


def _constants(sheet: Material) -> np.ndarray:
    """(k0, k1, k2, k3) [N/m] of a sheet whose table is constant."""
    return TABLE_ENTRY_TO_STRETCHING * sheet.stretching[0]


def strained(mesh, strain: np.ndarray) -> np.ndarray:
    """The nodes of a flat mesh under a Green strain [2, 2]."""
    shape = np.linalg.cholesky(np.eye(2) + 2 * strain).T
    return np.column_stack([mesh.nodes[:, :2] @ shape.T, mesh.nodes[:, 2]])


def test_constant_stretching_stiffness_is_the_jacobian_under_tension(mesh):
    """With constant coefficients, no shear and tension everywhere nothing is dropped: Gauss-Newton is Newton."""
    forces = Forces(mesh, isotropic("no shear", density=0.2, stretching=40.0, bending=1e-4, shear=0.0))
    motion = forces.motion(mesh.nodes * [1.2, 1.1, 1.0])
    moved = forces.jacobian("stretching", motion, 0.0, 1.0) - forces.stiffness("stretching", motion, 0.0, 1.0)
    onward = forces.stiffness("stretching", motion, 1.0, 1.0 / forces.timing.ahead)  # the tension's part is by `after`
    np.testing.assert_allclose(onward, moved / forces.timing.time_step, rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    ("strain", "expected"),
    [
        ((0.0, 0.0, 0.0), (62.292396, 0.0, 88.057334, 63.792714)),
        ((0.06, 0.0, 0.06), (84.941187, 4.716322, 157.327509, 63.523593)),
        ((0.1, 0.02, 0.0), (119.245183, 26.00082, 354.764724, 55.777019)),
        ((-0.05, 0.01, 0.2), (287.86673, 99.309646, 383.555176, 78.98211)),
    ],
)
def test_stretching_table_gives_the_reference_simulators_values(strain, expected):
    e00, e01, e11 = (torch.tensor(value, dtype=torch.float64) for value in strain)
    samples = torch.as_tensor(_sampled(CAMEL.stretching))
    for sheared in (e01, -e01):
        assert coefficients(samples, e00, e11, sheared).tolist() == pytest.approx(expected, rel=1e-6, abs=1e-6)


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
def test_bending_table_gives_the_reference_simulators_values(curvature, direction, expected):
    """By the force of one hinge at an angle of one radian, with constants such that K is the table's value."""
    from diffcloud.sim.terms.bending import _rows_at

    one = grid_cloth(2, 2, 1.0, 1.0)
    forces = Forces(one, CAMEL)
    of = forces.of("bending")._replace(
        rows=_rows_at(CAMEL.bending, np.array([[direction, direction]])),
        stiffness=np.ones(1),
        curvature=np.full(1, 2.5 * curvature),
    )
    forces.terms = forces.terms._replace(bending=of)
    energy = forces.energy("bending", forces.motion(folded(one, np.rad2deg(1.0))))
    assert 2e6 * energy == pytest.approx(expected, rel=1e-6)


def folded(one, degrees: float) -> np.ndarray:
    """The nodes of a mesh of one hinge, bent by an angle."""
    nodes = one.nodes.copy()
    first, second, tip, _ = one.hinges.nodes[0]
    axis = (one.nodes[second] - one.nodes[first]) / np.linalg.norm(one.nodes[second] - one.nodes[first])
    arm, turn = one.nodes[tip] - one.nodes[first], np.deg2rad(degrees)
    across = arm - axis * (axis @ arm)
    nodes[tip] += across * (np.cos(turn) - 1) + np.cross(axis, across) * np.sin(turn)
    return nodes


def test_bent_cylinder_has_the_energy_of_a_plate():
    """B = k_b/4 for a cylinder about a grid axis: the derivation in materials.py, by numbers."""
    radius, table_entry = 5.0, 3e-4
    fine = grid_cloth(5, 41, 0.1, 1.0)
    forces = Forces(fine, Material("m", 0.2, CONSTANT.stretching, np.full((3, 5), table_entry)))
    x = fine.nodes[:, 0]
    rolled = np.column_stack([radius * np.sin(x / radius), fine.nodes[:, 1], radius * (1 - np.cos(x / radius))])
    # 39 inner edges of 40 cells bend
    expected = 0.5 * table_entry / 4 / radius**2 * 0.1 * (39 / 40)
    assert forces.energy("bending", forces.motion(rolled)) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("lagged", [False, True])
def test_air_pushes_against_the_motion_and_as_formulas_say(lagged, mesh):
    forces = Forces(mesh, CONSTANT, Surrounding(wind=(0.0, 0.0, 0.5), lagged_air=lagged))
    forces.parameters = forces.parameters._replace(air_drag=np.array([0.3]), linear_drag=np.array([0.1]))
    velocities = np.tile([2.0, 0.0, -1.0], (len(mesh.nodes), 1))
    total = forces.force("air", forces.motion(mesh.nodes, velocities, velocities)).sum(0)
    area = 0.3 * 0.4
    assert total.tolist() == pytest.approx([-(0.3 + 0.1) * area * 2.0, 0.0, (1.5 + 0.1) * area * 1.5])


class TestShaped:
    """Hinges at rest as the mesh stands."""

    @pytest.fixture
    def bent(self, mesh, rng):
        return replace(mesh, nodes=mesh.nodes + 0.02 * rng.normal(size=mesh.nodes.shape))

    def test_no_force_as_it_stands_wherever_it_stands(self, bent, rng):
        shaped, flat = Forces(bent, CAMEL, shaped=True), Forces(bent, CAMEL)
        motion = shaped.motion(bent.nodes @ rotation(rng).T + rng.normal(size=3))
        least = np.abs(flat.force("bending", motion)).max()
        assert least > 1e-6
        assert np.abs(shaped.force("bending", motion)).max() < 1e-9 * least

    def test_a_fold_beyond_a_half_turn_goes_the_short_way(self):
        """From folded up by 175 degrees to folded down by 175: 10 degrees away, not 350."""
        one = grid_cloth(2, 2, 1.0, 1.0)
        assert len(one.hinges.length) == 1
        up = Forces(replace(one, nodes=folded(one, 175.0)), CONSTANT, shaped=True)
        flat = Forces(one, CONSTANT)
        down = up.energy("bending", up.motion(folded(one, -175.0)))
        assert down == pytest.approx(flat.energy("bending", flat.motion(folded(one, 10.0))), rel=1e-9)
