"""Problems for several simulators: known answers, a third opinion, and the others where they are installed.

`tests/physics/test_known_answers.py` has the same strip and elastica under mesh refinement, with the arcsim integrator.
Here they are those of the study `simulators`: the implicit one, a Poisson's ratio, and the meshes that all simulators get.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from diffcloud.errors import ConfigError
from diffcloud.mesh.shapes import grid_cloth
from diffcloud.simulators import explicit, mujoco, newton, ours, problem
from diffcloud.simulators.problem import Problem, Sheet, Track, distances
from diffcloud.simulators.problems import cantilever, elastica, strip
from studies.towel_problems import fold, lift, swing

NOISY = pytest.mark.filterwarnings("ignore")
"""The other simulators' own warnings."""


def short(given, seconds):
    return replace(given, seconds=seconds)


@pytest.mark.parametrize(
    ("gamma", "drop", "reach"), [(0.5, 0.06231, 0.99778), (5, 0.49590, 0.84666), (50, 0.90791, 0.24501)]
)
def test_the_heavy_elastica_is_that_of_the_tables(gamma, drop, reach):
    assert elastica(gamma) == pytest.approx((drop, reach), abs=2e-5)


@pytest.mark.parametrize("known", [strip, cantilever])
def test_strip_and_cantilever_are_within_two_percent_of_theory(known):
    test = known()
    found = test.measures(ours.simulate(test.problem))
    print({name: found[name] / value - 1 for name, value in test.theory.items()})
    for name, value in test.theory.items():
        assert found[name] == pytest.approx(value, rel=0.02), name


@pytest.mark.parametrize(("given", "seconds"), [(lift, 0.5), (swing, 0.25)])
def test_explicit_steps_with_forces_written_anew_move_the_towel_alike(given, seconds):
    """Elasticity, damping, contact, friction, prescribed nodes and BDF2 together."""
    chosen = short(given(), seconds)
    one, two = ours.simulate(chosen, steps=64), explicit.simulate(chosen, step=1e-4)
    apart, moved = distances(one, two), distances(one, Track(one.nodes[:1], 0.0))
    assert moved[-1] > 5e-3
    assert apart.max() < 0.01 * moved[-1]


def test_shorter_steps_are_nearer_to_still_shorter_ones():
    chosen = short(swing(), 0.25)
    rough, good, best = (ours.simulate(chosen, steps=steps) for steps in (4, 16, 64))
    assert distances(good, best)[-1] < 0.25 * distances(rough, best)[-1]


def test_the_gradient_is_that_of_differences():
    chosen = short(swing(), 0.2)
    _, slope, _, _ = ours.mean_height(chosen)
    low, high = (ours.mean_height(chosen, factor)[0] for factor in (0.99, 1.01))
    assert slope == pytest.approx((high - low) / np.log(1.01 / 0.99), rel=1e-3)


def test_problems_say_where_held_nodes_are():
    chosen = fold()
    places = chosen.held_at(chosen.times)
    moved, stays = (chosen.mesh.nodes[node] for node in chosen.held)
    assert places.shape == (len(chosen.times), 2, 3)
    np.testing.assert_allclose(places[-1, 0] - moved, [0.32, 0.24, 0.03], atol=1e-12)
    np.testing.assert_array_equal(places[:, 1], np.broadcast_to(stays, places[:, 1].shape))


def test_a_missing_simulator_says_how_to_install_it(monkeypatch):
    monkeypatch.setattr(problem.importlib.util, "find_spec", lambda name: None if name == "newton" else object())
    with pytest.raises(ConfigError, match=r"newton missing.*pip install 'diffcloud\[simulators\]'"):
        problem.installed()


@NOISY
@pytest.mark.slow
@pytest.mark.parametrize("known", [strip, cantilever])
def test_mujoco_and_newton_know_the_answers(known):
    """Vertex block descent, which converges slowly, is in `tests/diffcloud/cli/test_export.py`."""
    pytest.importorskip("mujoco")
    pytest.importorskip("newton")
    test = known()
    step = 4e-5 if known is cantilever else 2e-4
    own = test.measures(ours.simulate(test.problem))
    for track in (
        mujoco.simulate(test.problem, mujoco.Settings(step=step)),
        newton.simulate(test.problem, newton.Settings("semi_implicit", step)),
    ):
        found = test.measures(track)
        for name, value in test.theory.items():
            assert found[name] == pytest.approx(value, rel=0.05), name
            assert found[name] == pytest.approx(own[name], rel=0.02), name


@NOISY
@pytest.mark.slow
def test_mujoco_lifts_the_towel_alike():
    pytest.importorskip("mujoco")
    given = lift()
    apart = distances(ours.simulate(given), mujoco.simulate(given))
    lifted, swung = (apart[given.times <= time].max() for time in (1.5, 2.4))
    print(f"largest distance to 1.5 s {1e3 * lifted:.1f} mm, to 2.4 s {1e3 * swung:.1f} mm")
    assert lifted < 5e-3  # into which folds the hanging cloth then buckles is chance


@NOISY
@pytest.mark.slow
def test_mujoco_is_the_third_opinion_with_its_choices():
    """Hinges by their chord: what separates it from this simulator, and nothing else."""
    pytest.importorskip("mujoco")
    given = short(swing(), 0.75)
    third = explicit.simulate(given, explicit.Choices(chord=True))
    assert distances(mujoco.simulate(given, mujoco.Settings(step=1e-4)), third).max() < 1e-3


@pytest.mark.parametrize(("along", "across"), [(1.25, 1.25), (1.25, 1.0), (0.99, 1.02)])
def test_the_stiffness_that_makes_up_for_a_neo_hookean_membrane(along, across):
    """A uniformly stretched square: with ν = 0 and E = 2 μ, the stresses of both membranes are worked out by hand."""
    flat = grid_cloth(5, 5, 0.4, 0.4)
    sheet = Sheet(density=0.2, stretching=30.0, poisson=0.0, bending=1e-6, damping=0.0)
    given = Problem("square", flat, sheet, 0.1, {0: None})
    area = along * across
    linear = np.array([along * (along**2 - 1), across * (across**2 - 1)])  # μ times these
    other = np.array([along + (area - 2) * across, across + (area - 2) * along])
    motion = (flat.nodes * [along, across, 1.0])[None]
    expected = linear @ other / (other @ other)
    assert explicit.neo_hookean_gain(given, motion) == pytest.approx(expected, rel=1e-9)
    if along == across:
        assert expected == pytest.approx(1.0)


@NOISY
@pytest.mark.parametrize("shaped", [False, True])
def test_hinges_in_newton_rest_as_in_the_fit_and_other_cloths_keep_theirs(shaped):
    """A cloth that starts bent by a tenth, and another one in the same model with what the builder gives it."""
    engine = pytest.importorskip("newton")
    from diffcloud.simulators.scripts import run_newton

    flat = grid_cloth(3, 3, 0.2, 0.2)
    bent = replace(flat, nodes=np.column_stack([flat.nodes[:, :2], 0.1 * np.abs(flat.nodes[:, 0])]))
    sheet = Sheet(density=0.2, stretching=30.0, poisson=0.3, bending=1e-5, damping=0.01)
    cloth = Problem("bent", bent, sheet, 0.1, {0: None}, shaped=shaped).arrays()
    builder = engine.ModelBuilder()
    run_newton.add_cloth(builder, cloth)
    own = builder.edge_count
    run_newton.add_cloth(builder, cloth)
    model = builder.finalize(device="cpu")
    started = model.edge_rest_angle.numpy().copy()
    run_newton.finish_cloth(model, cloth)
    rest, bending = model.edge_rest_angle.numpy(), model.edge_bending_properties.numpy()
    assert np.abs(started[:own]).max() > 0.05
    np.testing.assert_allclose(rest[:own], started[:own] if shaped else 0.0)
    np.testing.assert_array_equal(rest[own:], started[own:])
    np.testing.assert_array_equal(bending[own:], np.tile([1.0, 0.0], (model.edge_count - own, 1)))
    inner = (model.edge_indices.numpy()[:own, :2] >= 0).all(axis=1)
    np.testing.assert_allclose(np.sort(bending[:own][inner, 0]), np.sort(cloth["hinge_stiffness"] / cloth["hinge_length"]))


@NOISY
@pytest.mark.slow
def test_newton_is_the_third_opinion_with_its_membrane():
    pytest.importorskip("newton")
    given = short(swing(), 0.5)
    given = replace(given, sheet=replace(given.sheet, damping=0.0))
    third = explicit.simulate(given, explicit.Choices(neo_hookean=True))
    assert distances(newton.simulate(given, newton.EXPLICIT), third).max() < 1e-3
