"""Errors of step size and mesh."""

from __future__ import annotations

import numpy as np

from studies.convergence import mesh_study, pairs, step_study
from tests.conftest import small_lift


def test_nine_pairs_are_the_middles_of_the_bounds_parts():
    found = pairs(small_lift())
    np.testing.assert_allclose(found["stretching"].unique(), 10 ** np.array([-2 / 3, 0, 2 / 3]), rtol=1e-6)
    assert len({*zip(found["stretching"].tolist(), found["density"].tolist(), strict=True)}) == 9


def test_smaller_steps_are_nearer_to_still_smaller_ones():
    scenario = small_lift(integrator="implicit", gap_m=0.5)
    coarse, fine = step_study(scenario, scenario.scene, [1, 4])
    assert (fine.errors < coarse.errors).all()
    assert 0 < coarse.nudged.max() < 1e-7 < coarse.pushed.min()
    assert np.median(coarse.pushed) < 3e-3  # two of the materials buckle one way or the other
    assert (coarse.integrator, coarse.order, fine.steps_per_frame) == ("implicit", 2, 4)


def test_a_finer_mesh_is_compared_at_the_nodes_of_the_scenario():
    scenario = small_lift(gap_m=0.5)
    (row,) = mesh_study(scenario, 1)
    assert row.nodes == len(scenario.scene.mesh.nodes)
    assert row.errors.shape == (9,)
    assert (row.errors > 0).all()
