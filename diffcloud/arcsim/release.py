"""Settings of the experiments published with the paper. Their scenes are in the published JSON files."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from diffcloud.arcsim.load import load_scene
from diffcloud.errors import SceneError
from diffcloud.io.published import PAPER_THRESHOLD, RELEASE_UNIT_M
from diffcloud.scene.scenarios.scenario import Scenario
from diffcloud.sim.surrounding import ReferenceContact


@dataclass(frozen=True)
class ReleaseExperiment:
    """Settings of one published experiment."""

    frames: int
    loss_frame: int
    points: int
    learning_rate: float
    threshold: float
    first_frame: int
    """Number of steps after which the state is compared with the first recorded file."""
    mass_nodes: tuple[int, ...] | None = None
    loss_faces: tuple[int, ...] | None = None


def _numbers(text: str) -> tuple[int, ...]:
    ranges = (part.split("-") for part in text.split(","))
    return tuple(i for part in ranges for i in range(int(part[0]), int(part[-1]) + 1))


RELEASE = {
    "release_lift": ReleaseExperiment(25, 24, 3500, 0.2, 0.0, 1, _numbers("5,9-11,17,21-23,27,28,33,35-37,39,43,45-48")),
    "release_fold": ReleaseExperiment(
        25,
        14,
        3500,
        0.2,
        0.0,
        1,
        _numbers("9-11,21,22,36,37,43,45-48"),
        _numbers("1,2,8-13,16,19,22-30,34,35,37,38,44-49,52,55,58-66,70,71"),
    ),
    "release_hang": ReleaseExperiment(15, 10, 3500, 0.3, PAPER_THRESHOLD, 0, _numbers("38-40,42,43,47,49,51,54-65,67,68")),
    "release_band": ReleaseExperiment(25, 24, 5500, 0.4, PAPER_THRESHOLD, 0),
}


def load_experiment(name: str, path: Path) -> Scenario:
    """Load a published experiment from its scene file.

    Args:
        name: a key of `RELEASE`.

    Raises:
        SceneError, MeshError: the file is faulty, or belongs to another experiment.
    """
    settings = RELEASE[name]
    scene = load_scene(path, reload_materials=True)
    surrounding = replace(scene.surrounding, reference_contact=ReferenceContact.as_published(), lagged_air=True)
    scene = replace(scene, integrator="arcsim", surrounding=surrounding)
    faces, nodes = settings.loss_faces, settings.mass_nodes
    for what, index, count in (("face", faces, len(scene.mesh.faces)), ("node", nodes, len(scene.mesh.nodes))):
        if index and max(index) >= count:
            raise SceneError(f"{path}: {name} needs {what} {max(index)}, but the cloth has {count}; wrong scene file?")
    return Scenario(
        name=name,
        scene=scene,
        frames=settings.frames,
        loss_frames=(settings.loss_frame,),
        loss_faces=None if faces is None else np.array(faces),
        node_sets={} if nodes is None else {"density": np.array(nodes)},
        points=settings.points,
        learning_rate=settings.learning_rate,
        threshold=settings.threshold,
        length_unit_m=RELEASE_UNIT_M,
        first_frame_time=settings.first_frame * scene.frame_time,
        # The published scripts partly use 0.05. Here all experiments use the same bounds.
        bounds={"stretching": (0.1, 10.0), "density": (0.1, 10.0)},
    )
