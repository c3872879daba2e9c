"""Page that shows episodes before and after a fit: clouds, cloth, gripper, table and cameras over time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from diffcloud.estimation.record import RecordingFit
from diffcloud.estimation.result import FittedMotion, recorded_pose
from diffcloud.estimation.targets import track_displacement
from diffcloud.io.episodes import Episode
from diffcloud.mesh.shapes import rectangle_surface
from diffcloud.reporting.overlay import Layer, Overlay, body_layers, held_layers, states_at
from diffcloud.reporting.rendering import render
from diffcloud.scene.scenarios import Scenario
from diffcloud.sim.simulate import rollout

_BESIDE = 0.25
"""Margin of the drawn table around the cloth, as a fraction of the cloth's size."""
_AXES_M = 0.1
_AXES_NAME = "axes of the world, 10 cm"


def build_view(
    overlays: Sequence[Overlay],
    *,
    title: str,
    note: str,
    facts: Sequence[tuple[str, str]],
    problems: Sequence[tuple[str, str]] = (),
) -> str:
    """Return the page as HTML text.

    Args:
        note: one or two sentences that describe the view.
        facts: name and value of each row of the table below the view.
        problems: name of the recording, and a sentence, for each fault.
    """
    data = [one.data() for one in overlays]
    return render("view.html", title=title, note=note, facts=facts, problems=problems, overlays=data)


def proposed_layers(scenario: Scenario) -> list[Layer]:
    """Return the cloth of a scenario before any motion, its held nodes, the table, and the directions of the world."""
    scene = scenario.scene
    cloth = Layer("proposed initial cloth", "mesh", [scene.mesh.nodes], "fitted", scene.mesh.faces)
    held = held_layers(scene.mesh.nodes[None], np.unique(scene.handles.nodes).astype(np.int64))
    return [cloth, *held, *table_layers(scenario, scene.mesh.nodes)]


def world_axes(near: NDArray[np.floating]) -> list[Layer]:
    """Return the directions of x, y and z of the world, 10 cm long, beside points [N, 3]."""
    low = near.min(axis=0)
    tips = low + _AXES_M * np.eye(3)
    names = ("x", "y", "z")
    lines = [Layer(_AXES_NAME, "line", [np.stack([low, tip])], "ink") for tip in tips]
    return [Layer(_AXES_NAME, "marks", [tips], "ink", labels=names), *lines]


def scene_layers(scenario: Scenario, episode: Episode, times: NDArray[np.float64]) -> list[Layer]:
    """Return the cloth of a scenario with its nominal material, moved by the recorded gripper, its held nodes, and the
    obstacles around it.

    Args:
        times: [T] times of the drawn frames [s]. After the end of the scenario, the cloth does not move.

    Raises:
        EpisodeError: the recorded grippers differ from those of the scene.
    """
    system, _ = scenario.scene.build()
    track = None
    if episode.gripper is not None:
        moved = track_displacement(episode, system.handles.grippers, scenario.steps, system.time_step)
        track = torch.as_tensor(moved)[None]
    with torch.no_grad():
        run = rollout(system, scenario.steps, track=track, drop_diverged=True)
    states = states_at(run.times.numpy(), times)
    nodes = run.positions[0].numpy()[states]
    known = np.isfinite(nodes).all(axis=(1, 2))
    shown = [frame if fine else scenario.scene.mesh.nodes for frame, fine in zip(nodes, known, strict=True)]
    cloth = Layer("cloth, nominal material", "mesh", shown, "fitted", system.mesh.faces)
    held = held_layers(np.stack(shown), np.unique(scenario.scene.handles.nodes).astype(np.int64))
    return [cloth, *held, *table_layers(scenario, np.concatenate(shown)), *body_layers(scenario.scene.bodies)]


def unposed_layer(scenario: Scenario, recording: RecordingFit, motion: FittedMotion, times: NDArray[np.float64]) -> Layer:
    """Return the fitted cloth at its pose in the scene, without the fitted alignment."""
    space, pose = recorded_pose(recording, length_unit_m=scenario.length_unit_m)
    nodes = space.back(torch.as_tensor(motion.nodes[states_at(motion.times, times)]), pose)[0].numpy()
    return Layer("fitted, where the scene has it", "mesh", nodes, "third", motion.faces, 0.35, shown=False)


def table_layers(scenario: Scenario, near: NDArray[np.float64]) -> list[Layer]:
    """Return the level planes of a scene, as rectangles around points [N, 3]."""
    low, high = near[:, :2].min(axis=0), near[:, :2].max(axis=0)
    margin = _BESIDE * float((high - low).max())
    layers = []
    for obstacle in scenario.scene.surrounding.obstacles:
        plane = obstacle.plane()
        if plane is None or abs(plane[0][2]) < 1 - 1e-6:
            continue
        square = rectangle_surface(0.5 * (low + high), 0.5 * (high - low) + margin, plane[1] * plane[0][2])
        layers.append(Layer("table", "mesh", [square.nodes], "soft", square.faces, 0.25))
    return layers
