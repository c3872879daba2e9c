"""Lists of neighbours against a look at all pairs in every step of a walk."""

from __future__ import annotations

import numpy as np
import pytest

from diffcloud.arcsim.contact.neighbours import meeting, neighbours_of, no_neighbours
from diffcloud.compiled import kernel
from tests.sim.contact.scenes import crumpled
from tests.sim.twins import broad_phase as twin

DISTANCE = 0.02


@kernel
def followed(surface, walk, distance):
    """Of each step of a walk [S + 1, N, 3]: pairs [C, 7], whether their boxes meet [C], and the boxes of points [N, 3]."""
    known = no_neighbours(surface, distance)
    found = []
    for step in range(len(walk) - 1):
        pairs = neighbours_of(surface, known, walk[step], walk[step + 1])
        meet = np.zeros(len(pairs), np.bool_)
        meet[meeting(surface, pairs, walk[step], walk[step + 1], distance)] = True
        low = known.low
        found.append((pairs, meet, low.copy()))
    return found


@pytest.mark.parametrize("stride", [1e-4, 2e-3, 0.02])
def test_every_pair_that_can_touch_in_a_step_is_listed(rng, stride):
    surface, points = crumpled(rng)
    walk = np.repeat(points[None], 13, axis=0)
    walk[1:, :25] += stride * rng.normal(size=(12, 25, 3)).cumsum(axis=0)
    steps = followed(surface, walk, DISTANCE)
    for step, (pairs, meet, _) in enumerate(steps):
        for kind, wanted in enumerate(twin.candidates(surface, walk[step], walk[step + 1], DISTANCE, among_fixed=False)):
            own = pairs[:, 0] == kind
            listed, meeting = (
                [tuple(sorted(pair) if kind else pair) for pair in of.tolist()]
                for of in (pairs[own, 5:], pairs[own & meet, 5:])
            )
            assert len(listed) == len(set(listed)), "each pair once"
            assert set(meeting) == wanted
    made = {low.tobytes() for *_, low in steps}
    assert len(made) == 1 if stride < 1e-3 else len(made) > 1


def test_the_points_of_listed_pairs_are_those_of_their_primitives(rng):
    surface, points = crumpled(rng)
    ((pairs, *_),) = followed(surface, np.stack([points, points]), DISTANCE)
    assert set(pairs[:, 0].tolist()) == {0, 1}
    for kind, *corners, a, b in pairs.tolist():
        first = surface.edges[a] if kind else [surface.points[a]]
        second = surface.edges[b] if kind else surface.faces[b]
        assert corners == [*first, *second]
