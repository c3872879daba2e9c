"""What is left out of clouds: distances to triangles against another library, the choice of free points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
import trimesh

from diffcloud.clouds import Augmentation, Background, CloudMaker
from diffcloud.clouds.augmentation import run_keys
from diffcloud.clouds.background import squared_triangle_distances
from diffcloud.mesh.topology import SurfaceMesh
from tests.conftest import flat_set

BOX = trimesh.creation.box((1.0, 0.4, 0.2))
BODY = SurfaceMesh(np.array(BOX.vertices), np.array(BOX.faces))


def test_distances_are_those_of_trimesh():
    rng = np.random.default_rng(0)
    corners, points = rng.normal(size=(40, 3, 3)), rng.normal(size=(500, 3))
    found = squared_triangle_distances(torch.from_numpy(points), torch.from_numpy(corners)).sqrt().numpy()
    pairs = np.repeat(points, 40, axis=0), np.tile(corners, (500, 1, 1))
    closest = trimesh.triangles.closest_point(pairs[1], pairs[0])
    np.testing.assert_allclose(found.ravel(), np.linalg.norm(closest - pairs[0], axis=1), atol=1e-12)


def test_points_near_the_body_are_held():
    points = torch.from_numpy(np.random.default_rng(1).uniform(-0.8, 0.8, (3, 4, 700, 3))).float()
    outside = (points.abs() - torch.tensor([0.5, 0.2, 0.1])).clamp(min=0).norm(dim=-1)
    inside = (torch.tensor([0.5, 0.2, 0.1]) - points.abs()).amin(-1)
    expected = (outside < 0.15) & (inside < 0.15)  # of a surface; nothing is 0.15 deep in this box
    assert bool((Background.build(BODY, 0.15).holds(points) == expected).all())
    assert 0.02 < float(expected.float().mean()) < 0.5


def test_the_first_free_points_are_taken_and_few_repeated():
    background = Background.build(BODY, 0.05)
    free = torch.arange(2, 8).float()[:, None] * torch.tensor([1.0, 0.0, 0.0])
    held = torch.zeros(3, 3) + torch.tensor([0.5, 0.0, 0.0])
    mixed = torch.stack([held[0], free[0], free[1], held[1], free[2], held[2]])
    few = torch.cat([held, free[:1], held[:2]])
    none = torch.cat([held, held])
    found = background.first_free(torch.stack([mixed, few, none]), 4)
    assert found[0, :, 0].tolist() == [2, 3, 4, 2]
    assert found[1, :, 0].tolist() == [2] * 4
    assert found[2, :, 0].tolist() == [0.5] * 4


def test_training_clouds_show_the_cloth_beside_the_body():
    """A body that lies on half of a sheet of 0.3 x 0.4 m hides that half and itself."""
    lid = SurfaceMesh(
        np.array([[-1.0, -1.0, 0.004], [0.0, -1.0, 0.004], [0.0, 1.0, 0.004], [-1.0, 1.0, 0.004]]),
        np.array([[0, 1, 2], [0, 2, 3]]),
    )
    simulated = replace(flat_set(frames=3), obstacle=lid)
    maker = CloudMaker.build(simulated, Augmentation.none(), points=900, background=Background.build(lid, 0.01))
    runs = torch.arange(3)
    clouds = maker.clouds(torch.as_tensor(simulated.nodes), run_keys(0, 0, runs))
    assert clouds.shape == (3, 3, 900, 3)
    assert float(clouds[..., 0].min()) > 0.009  # as far as the reach goes beside it
    assert float(clouds[..., 2].abs().max()) == 0.0
    assert len(clouds[0, 0].unique(dim=0)) > 500  # of 1,350 drawn half are free; the others repeat them
