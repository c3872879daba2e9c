"""Episodes with contact with meshes: derivatives three ways, batches, handles, and what is refused."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from diffcloud.errors import SceneError, UnresolvedContactError
from diffcloud.mesh import SurfaceMesh
from diffcloud.sim import rollout
from diffcloud.sim.surrounding import ReferenceContact
from tests.sim.contact.scenes import over_box
from tests.sim.directional import Episode, directions
from tests.sim.test_gradients import compare

VARIANTS = {
    "impacts": (ReferenceContact(), False),
    "proximity": (ReferenceContact(), True),
    "as published": (ReferenceContact.as_published(), True),
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_derivatives_of_an_episode(variant):
    contact, proximity = VARIANTS[variant]
    episode = Episode.build(over_box(contact, proximity=proximity), 6)
    found = compare(episode, directions(episode, per_field=1), steps=(1e-4, 1e-5, 1e-6))
    if not proximity:
        assert found.pop("friction")[0] == 0.0
    for name, (value, forward, central) in found.items():
        if abs(value) < 1e-12:  # friction that sticks does not depend on its coefficient
            assert name == "friction"
            continue
        assert forward <= 1e-8, name
        assert central <= 1e-5, name


def test_a_batch_is_its_entries():
    scenario = over_box(ReferenceContact())
    system, _ = scenario.scene.build()
    stretch = torch.tensor([0.3, 1.0, 4.0], dtype=torch.float64)
    batch = rollout(system, 8, properties=scenario.properties(system, {"stretching": stretch})).positions
    for index in range(3):
        one = {"stretching": stretch[index : index + 1]}
        single = rollout(system, 8, properties=scenario.properties(system, one)).positions[0]
        assert torch.equal(batch[index], single)


def inside_box(nodes: np.ndarray) -> np.ndarray:
    low, high = np.array([-0.047, -0.061, -0.2]), np.array([0.053, 0.043, 0.0])
    return ((nodes > low) & (nodes < high)).all(-1)


def test_the_cloth_stays_outside_of_the_box():
    scenario = over_box(ReferenceContact(), frames=10)
    system, _ = scenario.scene.build()
    nodes = rollout(system, 20).positions[0].numpy()
    assert not inside_box(nodes).any()
    assert nodes[-1, :, 2].min() < -0.01  # it hangs over the sides


def test_fine_meshes_run():
    """Contact of the cloth with itself couples nodes that share no element; obstacles have no rows in the matrix."""
    system, _ = over_box(ReferenceContact(), nodes=(15, 15)).scene.build()
    nodes = rollout(system, 6).positions[0].numpy()
    assert np.isfinite(nodes).all()
    assert not inside_box(nodes).any()
    assert nodes[-1, :, 2].min() < -0.01


def test_held_nodes_stay_held_and_obstacles_may_be_absent():
    scenario = over_box(ReferenceContact())
    free = replace(scenario.scene.surrounding, obstacles=())
    for surrounding in (scenario.scene.surrounding, free):
        system, _ = replace(scenario.scene, surrounding=surrounding).build()
        run = rollout(system, 6).positions[0]
        node = scenario.grasped[0]
        motion = next(h.motion for h in system.handles.handles if h.motion is not None)
        shift = torch.as_tensor(motion.at(np.cumsum(np.full(6, system.time_step)))[1])
        torch.testing.assert_close(run[1:, node] - shift, (run[0, node] - shift[0]).expand(6, -1), atol=1e-9, rtol=0)


def test_a_flat_table_agrees_with_the_half_space_for_impacts():
    """Without proximity a node on a plane is projected alike, but for the edges of the finite table."""
    scenario = over_box(ReferenceContact(), proximity=False)
    table = SurfaceMesh(np.array([[-9, -9, 0], [9, -9, 0], [0, 9, 0.0]]), np.array([[0, 1, 2]]))
    surrounding = replace(scenario.scene.surrounding, obstacles=(table,))
    mesh, _ = replace(scenario.scene, surrounding=surrounding).build()
    plane, _ = replace(scenario.scene, surrounding=replace(surrounding, reference_contact=None)).build()
    assert len(mesh.scene.plane_offsets) == 0
    assert mesh.scene.collides
    assert len(plane.scene.plane_offsets) == 1
    assert not plane.scene.collides
    found, expected = (rollout(system, 4).positions for system in (mesh, plane))
    torch.testing.assert_close(found, expected, atol=1e-9, rtol=0)
    assert expected[0, -1, :, 2].min() == pytest.approx(5e-4, abs=1e-9)


def test_impacts_that_cannot_be_resolved_are_named():
    """A cloth that starts within the top of the box has no side to be kept on."""
    scenario = over_box(ReferenceContact(), proximity=False, height=0.0)
    system, _ = scenario.scene.build()
    with pytest.raises(UnresolvedContactError, match=r"step 1\b.*batch entries \[0\].*points") as caught:
        rollout(system, 3)
    assert caught.value.entries == [0]
    assert "smaller time step" in str(caught.value)
    points = [int(number) for number in re.findall(r"\d+", caught.value.pair.partition("[")[2])]
    count = len(system.mesh.nodes) + sum(len(one.nodes) for one in system.setup.surrounding.obstacles)
    assert len(set(points)) == 4
    assert all(0 <= point < count for point in points)
    dropped = rollout(system, 3, drop_diverged=True)
    assert set(dropped.diverged) == {0}
    assert torch.isnan(dropped.positions[0, -1]).all()


def test_the_implicit_integrator_is_refused():
    scenario = over_box(ReferenceContact())
    with pytest.raises(SceneError, match="arcsim integrator"):
        replace(scenario.scene, integrator="implicit").build()


def test_the_published_quirks_are_off_by_default():
    default, published = ReferenceContact(), ReferenceContact.as_published()
    assert (default.smallest, default.count_once, default.residue) == (0.0, True, 0.0)
    assert (published.smallest, published.count_once, published.residue) == (1e-6, False, 1e-9)
