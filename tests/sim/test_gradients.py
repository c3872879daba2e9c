"""Gradients of whole episodes in float64: reverse against forward mode against central differences.

Every parameter, the gripper's path, and the initial positions and velocities; a lift of 25 frames (100 steps) without and
with table contact. The step of the central difference is swept and the best value taken: far steps see curvature and
contact events, near ones rounding.
"""

from __future__ import annotations

import pytest
import torch

from diffcloud.scene.scenarios import built_in, grid_scenario
from diffcloud.sim.integrators import INTEGRATORS
from tests.conftest import shaken, small_lift
from tests.sim.directional import SCALARS, STEPS, STILL_AIR, Episode, directions

FREE_FALL_GAP = 5.0
"""Over a table that is out of reach."""


def lift_episode(gap: float, **changes: object) -> Episode:
    scenario = grid_scenario(built_in("lift").model_copy(update={"gap_m": gap, **changes}))
    return Episode.build(scenario, scenario.steps)


def compare(episode: Episode, chosen: dict, steps: tuple[float, ...] = STEPS) -> dict[str, tuple[float, float, float]]:
    """name -> (value, relative error of forward against reverse, best relative error of central differences)."""
    listed = list(chosen.values())
    reverse, forward, central = episode.reverse(listed), episode.forward(listed), episode.central(listed, steps)
    found = {}
    for name, r, f, differences in zip(chosen, reverse, forward, central, strict=True):
        scale = max(abs(r), 1e-300)
        found[name] = (r, abs(f - r) / scale, min(abs(c - r) / scale for c in differences))
        print(f"{name:18s} {r:+.6e}  forward {found[name][1]:.1e}  central {found[name][2]:.1e}")
    return found


@pytest.mark.slow
def test_without_contact():
    episode = lift_episode(FREE_FALL_GAP)
    found = compare(episode, directions(episode))
    value, _, _ = found.pop("friction")
    assert value == 0.0  # nothing is touched, so friction cannot matter
    for name, (value, forward, central) in found.items():
        assert value != 0.0, name
        assert forward <= 1e-10, name
        assert central <= 1e-5, name


@pytest.mark.slow
def test_with_table_contact():
    episode = lift_episode(0.002)
    found = compare(episode, directions(episode, per_field=7))
    for name, (value, forward, _) in found.items():
        assert value != 0.0, name
        assert forward <= 1e-10, name
    good = [central <= 1e-4 for _, _, central in found.values()]
    assert sum(good) >= 0.95 * len(good), {name: entry for name, entry in found.items() if entry[2] > 1e-4}


@pytest.mark.parametrize("compression", [1.0, 0.1])
@pytest.mark.parametrize("gap", [FREE_FALL_GAP, 0.002])
def test_short_episodes(gap, compression):
    """The same on a small cloth over a few steps, for every run of the tests."""
    air = "still" if gap == FREE_FALL_GAP else "drag"
    episode = Episode.build(small_lift(gap_m=gap, compression=compression, air=air), 10)
    found = compare(episode, directions(episode, per_field=1))
    if compression < 1:
        plate = Episode.build(small_lift(gap_m=gap, air=air), 10)
        assert not torch.equal(plate.run(plate.base()), episode.run(episode.base()))
    if gap == FREE_FALL_GAP:
        assert found.pop("friction")[0] == 0.0
    for name, (value, forward, central) in found.items():
        assert value != 0.0, name
        assert forward <= 1e-10, name
        assert central <= 1e-5, name


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_tracks_of_two_grippers(integrator):
    """A direction of the track moves both."""
    episode = Episode.build(shaken(gap_m=FREE_FALL_GAP, integrator=integrator, nodes=(4, 4)), 4)
    assert episode.track.shape == (1, 4, 2, 3)
    moves = {name: move for name, move in directions(episode, per_field=2).items() if "track" in move}
    assert len(moves) == 2
    found = compare(episode, moves, steps=STEPS[2:])
    for name, (value, forward, central) in found.items():
        assert value != 0.0, name
        assert forward <= 1e-9, name
        assert central <= 1e-5, name


def test_one_step():
    episode = Episode.build(small_lift(), 1)
    found = compare(episode, directions(episode, per_field=1))
    assert abs(found.pop("friction")[0]) < 1e-10  # nothing slides
    assert found.pop("air_density")[0] == 0.0  # nothing has moved yet
    for name, (_, forward, central) in found.items():
        assert forward <= 1e-11, name
        assert central <= 1e-6, name


def test_converged_newton_steps():
    """The exact Jacobian has no symmetry, and the step is solved by Newton's method."""
    episode = Episode.build(small_lift(gap_m=FREE_FALL_GAP, nodes=(4, 4), integrator="implicit", air="still"), 3)
    found = compare(episode, directions(episode, per_field=1), steps=STEPS[2:])
    del found["friction"]
    for name, (value, forward, central) in found.items():
        assert value != 0.0, name
        assert forward <= 1e-9, name
        assert central <= 1e-5, name


def test_soft_handles():
    episode = Episode.build(small_lift(soft_handles=True), 6)
    found = compare(episode, directions(episode, per_field=1))
    del found["friction"]  # nothing slides
    for name, (_, forward, central) in found.items():
        assert forward <= 1e-10, name
        assert central <= 1e-5, name


@pytest.mark.parametrize("parameter", ["stretching", "density"])
def test_node_sets(parameter):
    """A multiplier on some nodes has the gradient that a central difference finds."""
    from dataclasses import replace

    scenario = small_lift()
    scenario = replace(scenario, node_sets={parameter: torch.arange(10).numpy()})
    system, _ = scenario.scene.build()

    def loss(value: torch.Tensor) -> torch.Tensor:
        from diffcloud.sim import rollout

        run = rollout(system, 6, properties=scenario.properties(system, {parameter: value}))
        return run.positions[:, -1].square().sum((1, 2))

    value = torch.tensor([1.7], dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(loss(value).sum(), value)
    h = 1e-5
    with torch.no_grad():
        plus, minus = loss(torch.tensor([1.7 + h, 1.7 - h], dtype=torch.float64))
    assert float(gradient) == pytest.approx(float(plus - minus) / (2 * h), rel=1e-5)
    assert float(gradient) != 0.0


def test_gradients_stay_finite_where_formulas_degenerate():
    """A cloth at rest, flat, unstretched, touching nothing: norms and angles are at their singular points."""
    scenario = small_lift(mesh_contact=False)  # a collapsed cloth lies in itself
    episode = Episode.build(scenario, 3)
    inputs = {name: value.requires_grad_(True) for name, value in episode.base().items()}
    inputs["positions"] = torch.as_tensor(episode.system.mesh.nodes)[None].requires_grad_(True)
    with torch.no_grad():
        inputs["positions"][:, 3] = inputs["positions"][:, 4]  # a collapsed edge
    found = torch.autograd.grad(episode.run(inputs).sum(), list(inputs.values()))
    assert all(torch.isfinite(gradient).all() for gradient in found)


def test_scalars_cover_every_parameter():
    from diffcloud.sim import PARAMETERS

    # these act only in scenes with contact of the cloth with itself, with bodies (test_contact_gradients), and with cloth
    # that gives way to compression (test_implicit)
    assert set(SCALARS) | set(STILL_AIR) | {"self_friction", "body_mass", "compression"} == set(PARAMETERS)
