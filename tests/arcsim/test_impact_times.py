"""Continuous detection against polynomial roots, dense sampling in time, another library, and complex steps."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.polynomial import Polynomial

from diffcloud.arcsim.contact.impact_times import NEVER, coplanarity_cubic, first_impact, unit_root
from diffcloud.arcsim.terms import kernels
from tests.arcsim.twins import impacts
from tests.arcsim.twins.meeting import meeting, on_both, square

KINDS = pytest.mark.parametrize("kind", [0, 1], ids=["point-face", "edge-edge"])


def motions(rng: np.random.Generator, count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Random ones; a third with partners that rest, a third with some that all points share."""
    found = []
    for index in range(count):
        start, change = rng.normal(size=(4, 3)), 1.5 * rng.normal(size=(4, 3))
        if index % 3 == 1:
            change[(1, 2)[index % 2] :] = 0.0
        if index % 3 == 2:
            change += 5 * rng.normal(size=3)
        found.append((start, start + change))
    return found


def roots_of(cubic: tuple[float, ...]) -> list[float]:
    return [root for k in range(3) if (root := unit_root(tuple(float(c) for c in cubic), k)) != NEVER]


def found_at(kind: int, start: np.ndarray, end: np.ndarray, smallest: float = 0.0) -> tuple[float, np.ndarray]:
    """(time, weights and normal [7])."""
    place = np.zeros(7)
    return first_impact(kind, start, end, smallest, place), place


def test_roots_are_those_of_the_polynomial(rng):
    cubic = rng.normal(size=(500, 4))
    cubic[:100, 3] = 0.0  # quadratic
    cubic[100:200, 2:] = 0.0  # linear
    cubic[200:250, 3] *= 1e-14  # nearly quadratic
    for coefficients in cubic:
        expected = np.roots(np.trim_zeros(coefficients[::-1], "f"))
        expected = np.sort(expected[np.isreal(expected)].real)
        expected = expected[(expected >= 0) & (expected <= 1)]
        np.testing.assert_allclose(np.unique(roots_of(coefficients)), expected, atol=1e-9)


@pytest.mark.parametrize(
    ("cubic", "expected"),
    [
        ((0, 0, 0, 0), [0]),  # coplanar throughout: met at once
        ((0, 1, 0, 0), [0]),  # at the start
        ((-1, 1, 0, 0), [1]),  # at the end
        ((1, 0, 0, 0), []),  # never
        ((-0.06, 0.56, -1.5, 1), [0.2, 0.3, 1]),  # (t - 0.2)(t - 0.3)(t - 1)
        ((0.25, -1, 1, 0), [0.5]),  # (t - 0.5)², which only touches
        ((-0.125, 0.75, -1.5, 1), [0.5]),  # (t - 0.5)³
        ((1e-40, 0, 0, 0), []),
        ((-5e-301, 1e-300, 0, 0), [0.5]),  # nothing is too small
        ((float("nan"), 1, 0, 0), []),
    ],
)
def test_special_cubics(cubic, expected):
    found = np.unique(roots_of(cubic))
    assert len(found) >= len(expected)  # a double root may be found from both sides
    assert np.abs(np.subtract.outer(found, expected)).min(axis=1, initial=np.inf).max(initial=0.0) < 1e-7
    assert np.abs(np.subtract.outer(expected, found)).min(axis=1, initial=np.inf).max(initial=0.0) < 1e-7


@KINDS
def test_cubic_is_the_volume(kind, rng):
    for start, end in motions(rng, 60):
        cubic = coplanarity_cubic(kind, start, end)
        size = np.abs(cubic).max()
        polynomial = impacts.volume_over_time(kind, start, end)
        np.testing.assert_allclose(cubic[: len(polynomial)], polynomial.coef, atol=1e-12 * size)
        assert not any(cubic[len(polynomial) :])
        for time in (0.0, 0.3, 1.0):
            expected = impacts.volume(kind, start + time * (end - start))
            assert Polynomial(cubic)(time) == pytest.approx(expected, abs=1e-12 * size)


@KINDS
def test_first_impact_is_the_first_root_on_both(kind, rng):
    """To rounding: the volume's change with time says how well its root is known."""
    met = 0
    for start, end in motions(rng, 600):
        expected, (found, place) = impacts.impact_time(kind, start, end), found_at(kind, start, end)
        assert (found == NEVER) == (expected == impacts.NEVER)
        if found == NEVER:
            continue
        met += 1
        polynomial = impacts.volume_over_time(kind, start, end)
        condition = np.abs(polynomial.coef).max() / abs(polynomial.deriv()(expected))
        assert found == pytest.approx(expected, abs=1e-13 * condition)
        at = start + found * (end - start)
        weights, normal = meeting(kind, at)
        flat = 1e-12 * (1 + np.abs(at).max() ** 4 / square(kind, at))
        np.testing.assert_allclose(place[:4], weights, atol=flat)
        np.testing.assert_allclose(place[4:], normal, atol=flat)
    assert met > 30


@KINDS
def test_first_impact_agrees_with_dense_sampling(kind, rng):
    """Without algebra: the volume changes its sign between two samples while the places are on both primitives."""
    samples = 1001
    wrong = met = 0
    for start, end in motions(rng, 300):
        path = start + np.linspace(0, 1, samples)[:, None, None] * (end - start)
        x = path.transpose(1, 0, 2)
        a, b, d = (x[1] - x[0], x[3] - x[2], x[2] - x[0]) if kind else (x[2] - x[1], x[3] - x[1], x[0] - x[1])
        side = np.sign((np.cross(a, b) * d).sum(axis=1))
        changes = [k for k in np.flatnonzero(side[1:] != side[:-1]) if on_both(kind, meeting(kind, path[k])[0], 0.0)]
        expected = (changes[0] + 0.5) / (samples - 1) if changes else NEVER
        found, _ = found_at(kind, start, end)
        wrong += abs(found - expected) > 1 / (samples - 1)
        met += found != NEVER
    # sampling misses two roots between two samples, and errs on places within a sample of a border
    assert wrong <= 0.02 * 300
    assert met > 15


@KINDS
def test_first_impact_agrees_with_another_library(kind, rng):
    """Tight inclusion gives a time that is never too late, and meetings of what comes within a millionth."""
    ipctk = pytest.importorskip("ipctk")
    tight = ipctk.TightInclusionCCD(tolerance=1e-7, conservative_rescaling=0.99)
    ask = tight.edge_edge_ccd if kind else tight.point_triangle_ccd
    met = 0
    for start, end in motions(rng, 300):
        found, _ = found_at(kind, start, end)
        hit, time = ask(*start, *end)
        assert hit == (found != NEVER)
        if hit:
            met += 1
            assert found - 1e-3 < time <= found + 1e-12
    assert met > 15


@KINDS
@pytest.mark.parametrize("way", ["together", "along a normal", "in the plane", "apart", "not at all"])
def test_degenerate_motions(kind, way, rng):
    """Primitives that cross in one plane and go nowhere, in it or out of it; or one goes straight through."""
    x = np.array(
        [[0, 0, 0.0], [1, 1, 0], [0, 1, 0], [1, 0, 0]] if kind else [[0.2, 0.2, 0.0], [0, 0, 0], [1, 0, 0], [0, 1, 0]]
    )
    up = np.zeros((4, 3))
    up[: 2 if kind else 1, 2] = 1.0
    match way:
        case "together":
            start, end, expected = x + 0.5 * up, x + 0.5 * up + rng.normal(size=3), NEVER
        case "along a normal":
            start, end, expected = x + up, x - 3 * up, 0.25
        case "in the plane":
            start, end, expected = x, x + [0.1, 0.05, 0.0] * up.any(axis=1)[:, None], 0.0
        case "apart":
            start, end, expected = x, x + up, 0.0  # touching counts
        case _:
            start, end, expected = x, x.copy(), 0.0
    assert found_at(kind, start, end)[0] == pytest.approx(expected, abs=1e-15)


def test_parallel_edges_and_faces_without_area_never_meet():
    """There is no common normal. What is there to hold apart other pairs do."""
    line = np.array([[0, 0, 0.0], [1, 0, 0], [0.2, 0, 0.1], [0.8, 0, 0.1]])
    assert found_at(1, line, line - [[0, 0, 0.0], [0, 0, 0], [0, 0, 0.2], [0, 0, 0.2]])[0] == NEVER
    flat = np.array([[0.5, 0, 0.1], [0, 0, 0], [1, 0, 0], [2, 0, 0]])
    assert found_at(0, flat, flat - [[0, 0, 0.2], [0, 0, 0], [0, 0, 0], [0, 0, 0]])[0] == NEVER


@KINDS
def test_small_pairs_never_meet_where_asked(kind, rng):
    start, end = next((s, e) for s, e in motions(rng, 300) if found_at(kind, s, e)[0] not in (NEVER, 0.0))
    time, _ = found_at(kind, start, end)
    area = square(kind, start + time * (end - start))
    assert found_at(kind, start, end, 0.999 * area)[0] == time
    assert found_at(kind, start, end, 1.001 * area)[0] != time


def meeting_kernels(kind: int):
    name = "edge_edge_meeting" if kind else "point_face_meeting"
    return (getattr(kernels, f"{name}_{way}") for way in ("value", "tangent", "reverse"))


@KINDS
def test_meeting_has_the_derivatives_of_root_and_frame(kind, rng):
    """Complex steps: the root moves with the coefficients, and the frame with the root. Reverse is the transpose."""
    value, tangent, reverse = meeting_kernels(kind)
    tiny, checked = 1e-40, 0
    for start, end in motions(rng, 400):
        time, place = found_at(kind, start, end)
        if time == NEVER or time == 0.0:
            continue
        inputs, constants = np.concatenate([start.ravel(), end.ravel()]), np.array([time])
        outputs, rates, found = np.empty(7), rng.normal(size=(2, 24)), np.empty((2, 7))
        value(inputs, constants, outputs)
        np.testing.assert_allclose(outputs, place, rtol=1e-9, atol=1e-9)  # at the root to rounding
        tangent(inputs, constants, rates, found)
        for rate, change in zip(rates, found, strict=True):
            first, last = (inputs + 1j * tiny * rate).reshape(2, 4, 3)
            root = impacts.refined(impacts.volume_over_time(kind, first, last), time)
            expected = np.concatenate(meeting(kind, first + root * (last - first))).imag / tiny
            np.testing.assert_allclose(change, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
        adjoint, gradients = rng.normal(size=7), np.zeros(24)
        reverse(inputs, constants, adjoint, gradients)
        np.testing.assert_allclose(rates @ gradients, found @ adjoint, rtol=1e-12, atol=1e-12 * np.abs(found).max())
        checked += 1
    assert checked > 25


@KINDS
def test_a_grazing_pair_keeps_its_time(kind):
    """Points that stay in one plane have no derivative of the time, only of weights and normal there."""
    _, tangent, reverse = meeting_kernels(kind)
    x = np.array(
        [[0, 0, 0.0], [1, 1, 0], [0, 1, 0], [1, 0, 0]] if kind else [[0.2, 0.2, 0.0], [0, 0, 0], [1, 0, 0], [0, 1, 0]]
    )
    inputs = np.concatenate([x.ravel(), np.add(x, (0.1, 0.2, 0.0)).ravel()])
    for time, rate in itertools.product((0.0, 0.5), np.eye(24)):
        found, gradients = np.empty((1, 7)), np.zeros(24)
        tangent(inputs, np.array([time]), rate[None], found)
        first, last = (inputs + 1e-40j * rate).reshape(2, 4, 3)
        expected = np.concatenate(meeting(kind, first + time * (last - first))).imag / 1e-40
        np.testing.assert_allclose(found[0], expected, atol=1e-12)
        for k in range(7):
            gradients[:] = 0.0
            reverse(inputs, np.array([time]), np.eye(7)[k], gradients)
            assert gradients @ rate == pytest.approx(found[0, k], abs=1e-12)
