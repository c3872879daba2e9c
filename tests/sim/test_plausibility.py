"""Motions that no cloth can have are told from those that one can."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffcloud.errors import DivergedError
from diffcloud.mesh import grid_cloth
from diffcloud.scene.scenarios import load_scenario
from diffcloud.sim.plausibility import Motion, implausible
from diffcloud.sim.simulate import rollout

STEP, STEPS = 0.02, 50
T = STEP * np.arange(STEPS + 1)


def motion(displacement, **changes):
    """A square cloth of 0.2 m whose nodes are all displaced by [S + 1, 3]; its first node is held where it is."""
    mesh = grid_cloth(4, 4, 0.2, 0.2)
    positions = mesh.nodes + np.asarray(displacement)[:, None]
    made = Motion(
        positions=positions,
        time_step=STEP,
        mass=np.full(16, 0.01),
        size=mesh.size,
        places=np.tile(positions[0, :1], (STEPS + 1, 1, 1)),
        held=np.ones((STEPS, 1), dtype=bool),
        gravity=np.array([0.0, 0.0, -9.81]),
        wind=0.0,
        velocities=np.zeros((16, 3)),
        others=np.zeros((STEPS + 1, 0, 3)),
        push=0.0,
    )
    return replace(made, **changes)


def along(z):
    return np.stack([0 * z, 0 * z, z], axis=1)


def nothing_stored(_):
    return 0.0


def free(**changes):
    return {"held": np.zeros((STEPS, 1), dtype=bool), **changes}


def test_a_cloth_at_rest_is_plausible():
    assert implausible(motion(along(0 * T)), nothing_stored) is None


def test_a_node_three_sizes_away_from_every_handle_is_not_unless_the_weight_took_it_there():
    mesh = grid_cloth(4, 4, 0.2, 0.2)
    sinking = motion(along(-1.2 * T))
    step, reason = implausible(sinking, lambda step: 10.0 * step)
    farthest = np.linalg.norm(mesh.nodes - mesh.nodes[0], axis=1).max()
    expected = np.flatnonzero(np.hypot(1.2 * T, farthest) > 3 * mesh.size)[0]
    assert step == expected
    assert "from everything that held the cloth" in reason
    near = motion(along(-1.2 * T), places=sinking.positions[:, :1])  # the handle goes along
    assert implausible(near, lambda step: 10.0 * step) is None
    work = 16 * 0.01 * 9.81 * 1.2 * STEP
    assert implausible(sinking, lambda step: work * step) is None
    rising = motion(along(1.2 * T))
    assert implausible(rising, lambda step: work * step) is not None


def test_free_fall_is_plausible_and_twice_its_distance_is_not():
    assert implausible(motion(along(-0.5 * 9.81 * T**2), **free()), nothing_stored) is None
    far = motion(along(-1.1 * 9.81 * T**2 - 3 * 0.4), **free())
    assert implausible(far, nothing_stored) is not None


def test_a_cloth_that_was_let_go_may_fall():
    """Held for half the time, then in free fall."""
    held = (np.arange(1, STEPS + 1) <= STEPS // 2)[:, None]
    late = np.clip(T - T[STEPS // 2], 0, None)
    assert implausible(motion(along(-0.5 * 9.81 * late**2), held=held), nothing_stored) is None


def test_kinetic_energy_from_nowhere_is_told():
    """Near the handle, but much too quick for gravity to have done it: unless elastic energy was stored before."""
    shaking = motion(along(0.2 * np.sin(40 * T)))
    step, reason = implausible(shaking, nothing_stored)
    assert step == 1
    assert "kinetic energy" in reason
    assert implausible(shaking, lambda step: 2.0) is None


def test_a_quick_handle_explains_a_quick_cloth():
    shaken = along(0.2 * np.sin(40 * T))
    made = motion(shaken)
    assert implausible(replace(made, places=made.positions[:, :1]), nothing_stored) is None


def test_a_force_explains_what_it_pushes():
    """A cloth that nothing holds is driven sideways at 3 g; and not at twice that."""
    driven = 0.5 * 3 * 9.81 * np.stack([T**2, 0 * T, 0 * T], axis=1)
    made = motion(driven, **free(gravity=np.zeros(3)))
    pushed = replace(made, push=3 * 9.81 * 16 * 0.01)
    assert implausible(made, nothing_stored) is not None
    assert implausible(pushed, nothing_stored) is None
    assert implausible(replace(pushed, positions=made.positions[:1] + 2 * driven[:, None]), nothing_stored) is not None


def test_the_last_digits_of_a_cloth_at_rest_are_no_motion():
    """Without weight and handles nothing else explains them."""
    noise = np.random.default_rng(0).choice([-1, 0, 1], STEPS + 1) * 2.0**-54
    still = motion(along(noise), **free(gravity=np.zeros(3)))
    assert implausible(still, nothing_stored) is None
    step, _ = implausible(motion(along(1e6 * noise), **free(gravity=np.zeros(3))), nothing_stored)
    assert step <= 5


def test_a_cloth_may_bounce_off_an_obstacle_at_twice_its_speed():
    """Not at four times its speed, nor off nothing."""
    obstacle = along(0.1 * T)[:, None]
    quiet = free(gravity=np.zeros(3))
    assert implausible(motion(along(0.2 * T), others=obstacle, **quiet), nothing_stored) is None
    assert implausible(motion(along(0.4 * T), others=obstacle, **quiet), nothing_stored) is not None
    assert implausible(motion(along(0.2 * T), **quiet), nothing_stored) is not None


def test_an_explosion_inside_the_bounds_is_a_named_error():
    """Drag that is taken from before the step, as ARCSim does, throws light cloth back harder than it came."""
    scenario = load_scenario("vest_hang")
    lagged = replace(scenario.scene.surrounding, lagged_air=True)
    system, _ = replace(scenario.scene, surrounding=lagged, frame_steps=3).stepped("arcsim").build()
    values = {"air_density": [1.0, 6.9], "density": [1.0, 0.1]}
    tensors = {name: torch.tensor(pair, dtype=torch.float64) for name, pair in values.items()}
    properties = scenario.properties(system, tensors)
    with pytest.raises(DivergedError, match=r"batch entries \[1\]: .*(kinetic energy|from everything that held)"):
        rollout(system, 8, properties=properties)
    kept = rollout(system, 8, properties=properties, drop_diverged=True)
    assert list(kept.diverged) == [1]
    step = kept.diverged[1].step
    assert bool(kept.positions[0].isfinite().all())
    assert bool(kept.positions[1, :step].isfinite().all())
    assert bool(kept.positions[1, step:].isnan().all())
