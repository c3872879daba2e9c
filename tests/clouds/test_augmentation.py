"""Training clouds: where their points lie, how many faces they see, their noise, their seeds, their obstacles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffcloud.clouds import Augmentation, CloudMaker
from diffcloud.clouds.augmentation import run_keys
from diffcloud.clouds.keyed_random import normal, stream_keys, uniform
from diffcloud.errors import ConfigError
from diffcloud.io.simulated import SimulatedSet
from diffcloud.mesh import grid_cloth
from diffcloud.mesh.topology import SurfaceMesh
from diffcloud.regressors.dataset import CloudDataset
from tests.conftest import flat_set

POLE = SurfaceMesh(np.array([[5.0, 0, 0], [6, 0, 0], [5, 0, 1]]), np.array([[0, 1, 2]]))

# two squares, one above the other, and a third beside them
_CORNERS = ((0, 0), (1, 0), (0, 1), (1, 1))
SQUARES = [[x + at, y, z] for at, z in ((0, 0.0), (0, 0.1), (3, 0.0)) for x, y in _CORNERS]
SQUARE_FACES = [[4 * k + a, 4 * k + b, 4 * k + c] for k in range(3) for a, b, c in ((0, 1, 2), (1, 3, 2))]


def clouds_of(simulated: SimulatedSet, augmentation: Augmentation, *, points=2000, epoch=0, runs=(0, 1, 2)) -> torch.Tensor:
    maker = CloudMaker.build(simulated, augmentation, points=points)
    index = torch.tensor(runs)
    return maker.clouds(torch.as_tensor(simulated.nodes)[index], run_keys(7, epoch, index))


def seen_faces(simulated: SimulatedSet, clouds: torch.Tensor) -> np.ndarray:
    """bool [B, T, F] which faces of a flat 4 x 5 grid hold points, by brute force."""
    corners = simulated.nodes[0, 0][simulated.faces][..., :2].astype(float)  # [F, 3, 2]
    edges = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=-1)
    local = np.einsum("fij,btnfj->btnfi", np.linalg.inv(edges), clouds.numpy()[..., None, :2] - corners[:, 0])
    inside = (local > 1e-3).all(-1) & (local.sum(-1) < 1 - 1e-3)
    return inside.any(axis=2)


class TestKeyedRandom:
    def test_first_word_of_splitmix64(self):
        """The published first output for the seed 0 is 0xE220A8397B1DCDAF."""
        word = 0xE220A8397B1DCDAF
        expected = [(word >> shift & 2**21 - 1) / 2**21 for shift in (1, 22, 43)]
        assert uniform(torch.zeros(1, dtype=torch.int64), 1).flatten().tolist() == expected

    def test_streams_depend_on_their_key_alone(self):
        keys = stream_keys(3, torch.arange(5), 1)
        assert len(set(keys.tolist()) | set(stream_keys(3, 7, torch.arange(5)).tolist())) == 10
        assert stream_keys(3, 1, 2) != stream_keys(3, 2, 1)
        torch.testing.assert_close(uniform(keys, 40)[2:3, :7], uniform(keys[2:3], 7), rtol=0, atol=0)

    def test_moments_and_independence(self):
        numbers = uniform(stream_keys(torch.arange(20)), 5000)
        assert float(numbers.min()) >= 0
        assert float(numbers.max()) < 1
        assert float(numbers.mean()) == pytest.approx(0.5, abs=0.003)
        assert float(numbers.var()) == pytest.approx(1 / 12, abs=0.001)
        correlation = torch.corrcoef(torch.cat([numbers[0].T, numbers[1].T, numbers[0, 1:].T[:, :1].expand(-1, 5000)]))
        assert float((correlation[:6, :6] - torch.eye(6)).abs().max()) < 0.06
        noise = normal(stream_keys(torch.arange(20)), 5000)
        assert float(noise.mean()) == pytest.approx(0, abs=0.01)
        assert float(noise.var()) == pytest.approx(1, abs=0.02)
        assert float((noise**4).mean()) == pytest.approx(3, abs=0.1)


class TestSurface:
    def test_points_lie_on_the_faces_in_proportion_to_area(self):
        simulated = flat_set(
            nodes_of=[[0, 0, 0], [3, 0, 0], [0, 1, 0], [0, 0, 5], [1, 0, 5], [0, 1, 5]], faces=[[0, 1, 2], [3, 4, 5]]
        )
        clouds = clouds_of(simulated, Augmentation.none(), points=20_000)
        upper = clouds[..., 2] > 2.5  # areas 3 : 1
        assert float(upper.float().mean()) == pytest.approx(0.25, abs=0.005)
        low = clouds[~upper]
        assert bool(((low[:, :2] >= 0) & (low[:, :1] / 3 + low[:, 1:2] <= 1 + 1e-6)).all())
        assert float(low[:, 0].mean()) == pytest.approx(1.0, abs=0.02)  # a triangle's centroid: uniform inside

    def test_only_the_loss_faces_are_seen_unless_asked_otherwise(self):
        simulated = replace(flat_set(), loss_faces=np.array([0, 5, 6]))
        seen = seen_faces(simulated, clouds_of(simulated, Augmentation.none()))
        assert np.flatnonzero(seen.any((0, 1))).tolist() == [0, 5, 6]
        whole = clouds_of(simulated, replace(Augmentation.none(), loss_faces_only=False))
        assert seen_faces(simulated, whole).all()

    def test_the_obstacle_is_seen_by_its_area_and_without_noise(self):
        simulated = replace(flat_set(), obstacle=POLE)  # 0.5 m² beside 0.12 m²
        clouds = clouds_of(simulated, Augmentation(keep=(1.0, 1.0), jitter_m=0.05), points=4000)
        pole = clouds[..., 0] > 3
        assert float(pole.float().mean()) == pytest.approx(0.5 / 0.62, abs=0.08)  # noise changes the cloth's area
        assert float(clouds[pole][:, 1].abs().max()) == 0.0
        assert float(clouds[~pole][:, 2].abs().max()) > 0.001


class TestOcclusion:
    @pytest.mark.parametrize("keep", [0.7, 0.85, 1.0])
    def test_the_stated_fraction_of_faces_is_seen(self, keep):
        simulated = flat_set()
        seen = seen_faces(simulated, clouds_of(simulated, Augmentation(keep=(keep, keep), jitter_m=0.0)))
        assert (seen.sum(-1) == round(keep * len(simulated.faces))).all()
        assert (seen == seen[:, :1]).all()  # what is hidden stays hidden
        if keep < 1:
            assert (seen[0] != seen[1]).any()  # runs hide different faces

    def test_fractions_fill_the_range(self):
        simulated = flat_set(runs=60)
        runs = tuple(range(60))
        seen = seen_faces(simulated, clouds_of(simulated, Augmentation(jitter_m=0.0), points=600, runs=runs))[:, 0].mean(-1)
        assert seen.min() >= 0.69
        assert seen.min() < 0.74
        assert seen.max() > 0.96

    def test_a_falling_fraction_hides_more_and_more(self):
        simulated = flat_set(frames=4)
        seen = seen_faces(simulated, clouds_of(simulated, Augmentation(keep=(0.7, 0.7), falling=True, jitter_m=0.0)))
        total = len(simulated.faces)
        assert (seen.sum(-1) == [round(total * fraction) for fraction in (1, 0.9, 0.8, 0.7)]).all()
        assert (seen[:, 1:] <= seen[:, :-1]).all()


class TestViewpoints:
    @pytest.mark.parametrize(
        ("viewpoints", "layers"),
        [
            (((0.5, 0.5, 9.0),), {0.1, 3.0}),
            (((0.5, 0.5, -9.0),), {0.0, 3.0}),
            (((0.5, 0.5, 9.0), (0.5, 0.5, -9.0)), {0.0, 0.1, 3.0}),
            ((), {0.0, 0.1, 3.0}),
        ],
    )
    @pytest.mark.parametrize("unit", [1.0, 0.35])
    def test_what_a_layer_hides_is_not_sampled(self, viewpoints, layers, unit):
        nodes = np.array(SQUARES) / unit
        simulated = replace(flat_set(nodes_of=nodes.tolist(), faces=SQUARE_FACES), length_unit_m=unit)
        places = tuple((x / unit, y / unit, z / unit) for x, y, z in viewpoints)
        seen = replace(Augmentation.none(), viewpoints=places, loss_faces_only=False)
        cloud = unit * clouds_of(simulated, seen, points=500)
        height = torch.where(cloud[..., 0] > 2, 3.0, cloud[..., 2])
        assert {round(one, 4) for one in height.flatten().tolist()} == layers

    def test_a_data_set_shows_it_too(self):
        simulated = flat_set(nodes_of=SQUARES, faces=SQUARE_FACES)
        data = CloudDataset(simulated, Augmentation.recorded(((0.5, 0.5, 9.0),)), frames="all", points=300)
        clouds, _ = data.batch([2, 0])
        assert float(clouds[clouds[..., 0] < 2][:, 2].min()) > 0.05  # noise of 4 mm, and a layer at 0.1 m
        everything, _ = CloudDataset(simulated, Augmentation(), frames="all", points=300).batch([2, 0])
        assert float(everything[everything[..., 0] < 2][:, 2].min()) < 0.05

    def test_where_nothing_is_seen_anything_may_be(self):
        simulated = flat_set(nodes_of=SQUARES[:8], faces=SQUARE_FACES[:4])
        maker = CloudMaker.build(simulated, Augmentation.none(), points=50)
        motion = torch.as_tensor(simulated.nodes)
        keys = run_keys(7, 0, torch.arange(len(motion)))
        nothing = torch.zeros(*motion.shape[:2], 4, dtype=torch.bool)
        torch.testing.assert_close(maker.clouds(motion, keys, nothing), maker.clouds(motion, keys), rtol=0, atol=0)

    def test_runs_lie_beside_their_place_and_stay_there(self):
        simulated = replace(flat_set(runs=300, frames=2), length_unit_m=0.5)
        runs = tuple(range(300))
        plain, moved = (
            clouds_of(simulated, replace(Augmentation.none(), shift_m=shift), points=4, runs=runs) for shift in (0.0, 0.01)
        )
        shift = moved - plain
        torch.testing.assert_close(shift, shift[:, :1, :1].expand_as(shift), rtol=0, atol=1e-6)
        assert float(shift[..., 2].abs().max()) == 0.0
        np.testing.assert_allclose(shift[:, 0, 0, :2].std(0), 0.01 / 0.5, rtol=0.15)


class TestNoise:
    def test_deviations_fill_their_range_and_scale_with_the_unit(self):
        one = replace(flat_set(runs=60), length_unit_m=1.0)
        heights = {}
        for unit in (1.0, 0.35):
            simulated = replace(one, length_unit_m=unit)
            cloud = clouds_of(simulated, Augmentation(keep=(1.0, 1.0), jitter_m=0.01), points=400, runs=tuple(range(60)))
            heights[unit] = cloud[..., 2].square().mean((1, 2)).sqrt()  # of points: interpolated between noisy nodes
        # the mean square of barycentric weights makes a point's noise sqrt(1/2) of a node's
        largest = 0.01 * 0.5**0.5
        assert float(heights[1.0].max()) < 1.3 * largest
        assert float(heights[1.0].max()) > 0.7 * largest
        assert float(heights[1.0].min()) < 0.15 * largest
        torch.testing.assert_close(heights[0.35], heights[1.0] / 0.35, rtol=0.1, atol=1e-5)

    def test_without_noise_the_cloth_stays_flat(self):
        assert float(clouds_of(flat_set(), Augmentation(jitter_m=0.0))[..., 2].abs().max()) == 0.0


class TestSeeds:
    def test_a_cloud_depends_on_run_and_epoch_but_not_on_the_batch(self):
        simulated = flat_set()
        all_runs = clouds_of(simulated, Augmentation())
        torch.testing.assert_close(clouds_of(simulated, Augmentation(), runs=(2,))[0], all_runs[2], rtol=0, atol=0)
        assert not torch.equal(all_runs[0], all_runs[1])
        assert not torch.equal(clouds_of(simulated, Augmentation(), epoch=1), all_runs)

    def test_the_order_of_points_says_nothing(self):
        """The first half of a cloud is a sample of the whole surface."""
        cloud = clouds_of(flat_set(), Augmentation.none(), points=8000)[0, 0]
        torch.testing.assert_close(cloud[:4000].mean(0), cloud[4000:].mean(0), rtol=0, atol=0.01)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"keep": (0.9, 0.7)}, "in order"),
        ({"keep": (0.0, 1.0)}, "0 < low"),
        ({"jitter_m": -1.0}, "zero or more"),
        ({"viewpoints": ((0.0, 0.0, 1.0),)}, "need loss_faces_only=False"),
        ({"shift_m": -1.0}, "shift_m must be a length"),
    ],
)
def test_bad_settings_are_refused(options, message):
    with pytest.raises(ConfigError, match=message):
        Augmentation(**options)


def test_no_points_are_refused():
    with pytest.raises(ConfigError, match="At least one point"):
        CloudMaker.build(flat_set(), Augmentation(), points=0)


def test_the_grid_of_these_tests():
    assert len(grid_cloth(4, 5, 0.3, 0.4).faces) == len(flat_set().faces)
