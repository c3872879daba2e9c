"""Where a recorded cloth lies: found from clouds that were laid there, refused where it cannot be."""

from __future__ import annotations

import math

import numpy as np
import pytest

from diffcloud.errors import EpisodeError
from diffcloud.io.episodes import Episode
from diffcloud.scene.scenarios.layout import find_layout, found_size, node_counts

SIZE = (0.40, 0.30)


def recorded(
    *, size=SIZE, yaw=0.0, centre=(0.5, 0.1), height=0.03, corner=(1, 1), noise=0.002, points=3000, travel=0.3, turn=None
) -> Episode:
    """Two frames of a flat cloth that rises with the gripper at one of its corners (signs of its own x and y)."""
    rng = np.random.default_rng(0)
    flat = (rng.random((points, 2)) - 0.5) * size
    c, s = math.cos(yaw), math.sin(yaw)
    rotation = np.array([[c, s], [-s, c]])  # for rows
    cloud = np.column_stack([flat @ rotation + centre, np.full(points, height)]) + noise * rng.standard_normal((points, 3))
    raised = cloud + np.array([0.0, 0.0, travel])
    place = np.array(corner) * np.array(size) / 2 @ rotation + centre
    track = np.array([[[*place, height]], [[*place, height + travel]]])
    if turn is not None:
        cloud, raised, track = cloud @ turn.T, raised @ turn.T, track @ turn.T
    return Episode.from_frames([cloud, raised], np.array([0.0, 0.1]), gripper=track)


def values(layout):
    return {name: entry.value for name, entry in layout.fields.items()}


@pytest.mark.parametrize("yaw_deg", [0.0, 17.0, 45.0, 80.0, 130.0, 200.0, 300.0])
@pytest.mark.parametrize("corner", [(1, 1), (-1, 1), (1, -1), (-1, -1)])
def test_the_cloth_is_found_where_it_was_laid(yaw_deg, corner):
    """Up to half a turn of a rectangle, which the grasped corner settles."""
    found = values(find_layout(recorded(yaw=math.radians(yaw_deg), corner=corner), SIZE))
    assert found["center_m"] == pytest.approx([0.5, 0.1], abs=0.003)
    assert found["table_height_m"] == pytest.approx(0.0294, abs=0.0002)
    apart = (found["yaw_deg"] - yaw_deg) % 180
    assert min(apart, 180 - apart) < 1.0
    half_turned = 90 < (found["yaw_deg"] - yaw_deg) % 360 < 270
    side, end = (-part if half_turned else part for part in corner)
    assert found["grasped"] == [f"{'right' if side > 0 else 'left'}_{'top' if end > 0 else 'bottom'}"]


def test_the_size_is_seen():
    assert found_size(recorded(yaw=0.4)) == pytest.approx(SIZE, abs=0.006)
    assert node_counts(SIZE) == (13, 10)
    assert node_counts((0.05, 3.0)) == (5, 13)


def test_the_gripper_may_hold_a_node_that_is_no_corner():
    found = values(find_layout(recorded(corner=(1, 0.05)), SIZE))
    (node,) = found["grasped"]
    assert node % 13 == 12  # on the right edge


def test_a_large_pad_at_a_corner_lies_inside_the_cloth():
    episode = recorded(corner=(1 - 0.05 / SIZE[0], 1 - 0.05 / SIZE[1]))  # its middle: 25 mm from both sides
    assert values(find_layout(episode, SIZE, 0.05))["grasped"] == ["right_top"]
    (node,) = values(find_layout(episode, SIZE, 0.0))["grasped"]
    assert node == 8 * 13 + 11


def test_every_value_has_a_reason():
    layout = find_layout(recorded(), SIZE)
    assert all(entry.reason for entry in layout.fields.values())
    assert layout.warnings == ()
    assert values(layout)["rate_hz"] == pytest.approx(10.0)
    assert values(layout)["frames"] == 1


_ON_ITS_SIDE = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=float)


@pytest.mark.parametrize(
    ("episode", "size", "message"),
    [
        (recorded(size=(400, 300), centre=(500, 100), height=30), SIZE, "look as if they were in millimetres"),
        (recorded(size=(1e-5, 1e-5), noise=0), SIZE, "Clouds are in metres"),
        (recorded(turn=_ON_ITS_SIDE), SIZE, "tilted by 90 degrees"),
        (recorded(noise=0.03), SIZE, "mm thick: the cloth does not lie flat"),
        (recorded(), (0.60, 0.30), "0.600 x 0.300 m was stated"),
        (recorded(), (SIZE[0], 1.15 * SIZE[1]), "was stated"),
        (recorded(corner=(5, 1)), SIZE, "m beside the cloth"),
        (Episode.from_frames([np.zeros((4, 3))], np.zeros(1)), SIZE, "no track of its gripper"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_simulated(episode, size, message):
    with pytest.raises(EpisodeError, match=message):
        find_layout(episode, size)


@pytest.mark.parametrize(
    ("episode", "message"),
    [
        (recorded(travel=0.01), "moves by 10 mm: such a motion shows little"),
        (recorded(points=60, noise=0.0), "fewer than 100 points"),
        (recorded(size=(1.07 * SIZE[0], 1.07 * SIZE[1])), "off the stated size"),
    ],
)
def test_what_is_odd_is_said(episode, message):
    assert any(message in warning for warning in find_layout(episode, SIZE).warnings)
