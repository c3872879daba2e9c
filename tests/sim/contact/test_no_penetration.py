"""No cloth passes through anything: every step of every contact-rich scene, searched by brute force."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from diffcloud.mesh import (
    ClothMesh,
    SurfaceMesh,
    box_surface,
    cylinder_surface,
    grid_cloth,
    rectangle_surface,
    sphere_surface,
)
from diffcloud.scene import Scenario, Scene, load_scenario
from diffcloud.sim.handles import Handle, Handles
from diffcloud.sim.materials import preset
from diffcloud.sim.motion import Keyframe, Motion
from diffcloud.sim.simulate import rollout
from diffcloud.sim.surrounding import ReferenceContact, Surrounding
from tests.sim.contact.penetration import find_penetrations

STEP = 1 / 60
CORNERS = [(0.2, 0.2), (9.0, 9.0), (0.2, 9.0), (9.0, 0.2)]
"""(stretch, mass) multipliers near the corners of the box that a fit searches."""
PUBLISHED = {
    "release_lift": "lift/demo_diamond25.json",
    "release_fold": "lift/demo_fold.json",
    "release_band": "band_stretch/demo.json",
    "release_hang": "cloth_hang/demo2.json",
}
TABLE = rectangle_surface([0, 0], [1, 1], 0.0)


def assert_no_penetration(scenario: Scenario, parameters: Sequence[tuple[float, float]] = ((1.0, 1.0),)) -> np.ndarray:
    """Simulate (stretch, mass) pairs in one batch and search every step of each; gives positions [B, S + 1, V, 3]."""
    system, _ = scenario.scene.build()
    stretch, mass = (torch.tensor(values, dtype=torch.float64) for values in zip(*parameters, strict=True))
    with torch.no_grad():
        run = rollout(
            system, scenario.steps, properties=scenario.properties(system, {"stretching": stretch, "density": mass})
        )
    positions = run.positions.numpy()
    for pair, trajectory in zip(parameters, positions, strict=True):
        found = find_penetrations(trajectory, system.mesh, system.obstacles)
        assert not found, f"stretching, density = {pair}: {len(found)} penetrations, the first is {found[0]}"
    return positions


def dropped(
    mesh: ClothMesh, obstacles: tuple[SurfaceMesh, ...], seconds: float, handles: tuple[Handle, ...] = ()
) -> Scenario:
    """A cloth in free fall onto obstacles."""
    scene = Scene(
        mesh=mesh,
        material=preset("soft-knit"),
        handles=Handles(handles, hard=True),
        frame_time=STEP,
        surrounding=Surrounding(air_density=1.2, obstacles=obstacles, reference_contact=ReferenceContact()),
        integrator="arcsim",
    )
    return Scenario("dropped", scene, frames=round(seconds / STEP), loss_frames=(-1,))


def lifted_grid(count: int, size: float, height: float) -> ClothMesh:
    flat = grid_cloth(count, count, size, size)
    return replace(flat, nodes=np.add(flat.nodes, (0.0, 0.0, height)))


@pytest.mark.slow
@pytest.mark.parametrize(
    "obstacle",
    [
        sphere_surface([0.013, 0.007, 0.12], 0.07, 2),
        box_surface([0.003, -0.2, 0.0], [0.2, 0.2, 0.15]),  # the cloth falls over its edge
        cylinder_surface([0.004, -0.3, 0.18], [0.004, 0.3, 0.18], 0.003, 8),  # a third of the mesh's spacing
    ],
    ids=["sphere", "box edge", "thin pole"],
)
def test_a_cloth_dropped_on(obstacle):
    mesh = lifted_grid(20, 0.2, 0.21)
    positions = assert_no_penetration(dropped(mesh, (obstacle, TABLE), 0.6))
    # without contact nothing would stay above the table's plane by more than the fall leaves
    assert positions[0, -1, :, 2].max() > 0.1


@pytest.mark.slow
def test_a_cloth_folded_onto_itself():
    """One side is carried over to the other, presses on it and is let go of."""
    mesh = lifted_grid(14, 0.2, 0.003)
    left, right = np.flatnonzero(mesh.nodes[:, 0] < -0.099), np.flatnonzero(mesh.nodes[:, 0] > 0.099)
    path = Motion(
        (
            Keyframe(0.0),
            Keyframe(0.4, (0.1, 0.0, 0.1)),
            Keyframe(0.8, (0.19, 0.0, 0.006)),
            Keyframe(1.0, (0.19, 0.0, 0.006)),
        )
    )
    handles = (*(Handle(int(node), path, end=1.0) for node in left), *(Handle(int(node)) for node in right))
    positions = assert_no_penetration(dropped(mesh, (TABLE,), 1.3, handles))
    assert np.ptp(positions[0, -1, :, 0]) < 0.15  # it is folded


@pytest.mark.slow
def test_two_cloths_dropped_on_each_other():
    """The upper one falls on the lower one, which lies over a ball; one mesh of two components."""
    lower, upper = lifted_grid(12, 0.2, 0.15), lifted_grid(9, 0.12, 0.19)
    count = len(lower.nodes)
    mesh = ClothMesh(
        nodes=np.concatenate([lower.nodes, np.add(upper.nodes, (0.011, 0.005, 0.0))]),
        verts=np.concatenate([lower.verts, np.add(upper.verts, (1.0, 0.0))]),
        vert_node=np.arange(count + len(upper.nodes)),
        face_verts=np.concatenate([lower.face_verts, upper.face_verts + count]),
    )
    positions = assert_no_penetration(dropped(mesh, (sphere_surface([0, 0, 0.07], 0.06, 2), TABLE), 0.6))
    assert positions[0, -1, count:, 2].max() > 0.12  # on top of the ball


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lift", "fold", "band_stretch", "vest_hang"])
def test_built_in_scenarios(name):
    assert_no_penetration(load_scenario(name), CORNERS)


@pytest.mark.slow
@pytest.mark.parametrize("name", PUBLISHED)
def test_published_scenes(name, release: Path):
    published = load_scenario(name, release / "conf" / "rigidcloth" / PUBLISHED[name])
    # the published quirks let small triangles through; without them nothing passes
    surrounding = replace(published.scene.surrounding, reference_contact=ReferenceContact())
    scene = replace(published.scene, surrounding=surrounding)
    assert_no_penetration(replace(published, scene=scene), CORNERS)
