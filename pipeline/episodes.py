"""`diffcloud episodes`: the first stage. Makes synthetic recordings, or checks and copies a person's own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from numpy.typing import NDArray

from diffcloud.errors import ConfigError
from diffcloud.io.episodes import Episode, read_episode, write_episode
from diffcloud.scene.scenarios import Scenario
from diffcloud.sensing import default_cameras, record, sample_surface
from diffcloud.sim.properties import PARAMETERS
from diffcloud.sim.simulate import rollout
from pipeline.config import EpisodesConfig, load_config
from pipeline.console import JsonFlag, ParamsFile, errors, finish, progress_bar
from pipeline.scenario_options import choose_scenario

_HIDDEN = ("stretch", "mass")


def episodes(
    out: Annotated[Path, typer.Option(help="Folder; episodes go to OUT/<scenario>/<episode>.npz.")],
    params: ParamsFile = None,
    json: JsonFlag = False,
) -> None:
    """Make or collect the recorded episodes of every scenario."""
    config = load_config(params)
    written: dict[str, list[str]] = {}
    with progress_bar("episodes", len(config.scenarios)) as update:
        for index, name in enumerate(config.scenarios):
            scenario = choose_scenario(name)
            if config.episodes.source == "synthetic":
                found = _synthetic(scenario, config.episodes, index)
            else:
                found = _own(Path(config.episodes.source) / name)
            for episode_name, episode in found.items():
                write_episode(out / name / f"{episode_name}.npz", episode)
            written[name] = list(found)
            update(index + 1, name)
    for name, names in written.items():
        errors.print(f"{name}: {', '.join(names)}")
    finish({"out": str(out), "episodes": written}, json)


def _synthetic(scenario: Scenario, config: EpisodesConfig, index: int) -> dict[str, Episode]:
    rng = np.random.default_rng([config.seed, index])
    hidden = _hidden(scenario, config, rng)
    system, _ = scenario.scene.build()
    properties = scenario.properties(system, {name: torch.as_tensor(values) for name, values in hidden.items()})
    with torch.no_grad():
        run = rollout(system, scenario.steps, properties=properties)
    nodes = run.positions[:, :: scenario.scene.frame_steps].numpy()
    times = run.times[:: scenario.scene.frame_steps].numpy()
    centre = nodes[0].reshape(-1, 3).mean(axis=0)
    cameras = default_cameras((float(centre[0]), float(centre[1]), float(centre[2]) + 0.1))
    obstacles = scenario.scene.surrounding.obstacles
    made = {}
    for repeat in range(config.per_scenario):
        meta: dict[str, Any] = {
            "scenario": scenario.name,
            "fabric": f"hidden{repeat + 1}",
            "repeat": 1,
            "source": "synthetic",
            "truth": {name: float(values[repeat]) for name, values in hidden.items()},
        }
        seed, faces = int(rng.integers(2**31)), system.mesh.faces
        if scenario.recorder == "whole_surface":
            obstacle = obstacles[0] if obstacles else None
            episode = sample_surface(nodes[repeat], faces, times, obstacle, points=scenario.points, seed=seed, meta=meta)
        else:
            meta["cameras"] = [camera.name for camera in cameras]
            episode = record(nodes[repeat], faces, times, cameras, grasped=scenario.grasped, seed=seed, meta=meta)
        made[f"{scenario.name}_hidden{repeat + 1}"] = episode
    return made


def _hidden(scenario: Scenario, config: EpisodesConfig, rng: np.random.Generator) -> dict[str, NDArray[np.float64]]:
    """Hidden multipliers, name -> [episodes]: as the paper draws them for its simulated targets (uniform over the fit's
    bounds), or log-uniform over the configured range for recordings by cameras."""
    if scenario.recorder == "whole_surface":
        low, high = np.transpose([scenario.bounds.get(name, PARAMETERS[name].bounds) for name in _HIDDEN])
        drawn = rng.uniform(low, high, (config.per_scenario, len(_HIDDEN)))  # more episodes leave the first as they are
        return dict(zip(_HIDDEN, drawn.T, strict=True))
    low, high = np.log(config.hidden_range)
    return {name: np.exp(rng.uniform(low, high, config.per_scenario)) for name in _HIDDEN}


def _own(folder: Path) -> dict[str, Episode]:
    files = sorted(folder.glob("*.npz"))
    if not files:
        raise ConfigError(
            f"{folder} holds no episodes (*.npz). Make them with `diffcloud import`, or set episodes.source: synthetic."
        )
    return {path.stem: read_episode(path) for path in files}
