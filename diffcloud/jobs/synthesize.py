"""Make synthetic recordings of all scenarios. The user's own recordings are in raw/."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from diffcloud.console import errors
from diffcloud.errors import ConfigError, DiffCloudError
from diffcloud.io.episodes import write_episode
from diffcloud.io.files import staged
from diffcloud.io.manifests import remove_files, write_manifest
from diffcloud.io.raw_episodes import raw_episode_files, read_description
from diffcloud.jobs.pool import Tell, run_all
from diffcloud.jobs.scenarios import choose_scenario
from diffcloud.jobs.settings import Config, SynthesizeConfig
from diffcloud.scene.scenarios import Scenario
from diffcloud.sensing.depth_camera import DepthNoise, published_cameras
from diffcloud.sensing.recorder import ClothMotion, record
from diffcloud.sensing.whole_surface import sample_surface
from diffcloud.sim.properties import PARAMETERS
from diffcloud.sim.simulate import rollout
from diffcloud.sim.system import System

_HIDDEN = ("stretching", "density")


def make_episodes(config: Config, out: Path, workers: int | None, scheduler: str | None = None) -> dict[str, list[str]]:
    """Make the recordings in OUT/<scenario>/<episode>, as raw episodes or .npz.

    Returns:
        Scenario -> names of the recordings.
    """
    settings = config.synthesize
    jobs = [EpisodesJob(name, index, settings, out / name) for index, name in enumerate(config.scenes)]
    if not settings.per_scenario:
        jobs = []
        write_manifest(out, [])
    written = {}
    for job, names, error in run_all("episodes", jobs, workers, scheduler=scheduler):
        if error is not None:
            raise DiffCloudError(error)
        written[job.scenario] = names
        errors.print(f"{job.scenario}: {', '.join(names)}")
    return written


@dataclass(frozen=True)
class EpisodesJob:
    """Makes the recordings of one scenario."""

    scenario: str
    index: int
    """Index of the scenario, from which its random seed is derived."""
    settings: SynthesizeConfig
    out: Path

    @property
    def label(self) -> str:
        return self.scenario

    def run(self, tell: Tell) -> list[str]:
        """Make the recordings and return their names."""
        scenario = choose_scenario(self.scenario)
        return _synthetic(scenario, self.settings, self.index, self.out, lambda _, text: tell(0.0, text))


def _synthetic(
    scenario: Scenario, config: SynthesizeConfig, index: int, out: Path, tell: Callable[[int, str], None]
) -> list[str]:
    """Simulate cloths with hidden parameters, and record them with depth cameras or as the whole surface."""
    rng = np.random.default_rng([config.seed, index])
    hidden = hidden_parameters(scenario, config, rng)
    system, nodes, times = simulated_frames(scenario, hidden)
    names = []
    for repeat in range(config.per_scenario):
        name, seed = f"{scenario.name}_hidden{repeat + 1}", int(rng.integers(2**31))
        meta: dict[str, Any] = {
            "scenario": scenario.name,
            "fabric": f"hidden{repeat + 1}",
            "repeat": 1,
            "truth": {key: float(values[repeat]) for key, values in hidden.items()},
        }
        record_motion(scenario, system, nodes[repeat], times, out, name, config, seed=seed, meta=meta, tell=tell)
        names.append(name)
    return names


def simulated_frames(
    scenario: Scenario, values: Mapping[str, NDArray[np.float64]]
) -> tuple[System, NDArray[np.float64], NDArray[np.float64]]:
    """Simulate E motions. Return the system, node positions [E, T, V, 3] at each frame, and frame times [T] [s].

    Args:
        values: parameter name -> values [E].

    Raises:
        DivergedError: a motion diverges.
    """
    system, _ = scenario.scene.build()
    properties = scenario.properties(system, {name: torch.as_tensor(column) for name, column in values.items()})
    with torch.no_grad():
        run = rollout(system, scenario.steps, properties=properties)
    steps = scenario.scene.frame_steps
    return system, run.positions[:, ::steps].numpy(), run.times[::steps].numpy()


def record_motion(
    scenario: Scenario,
    system: System,
    nodes: NDArray[np.float64],
    times: NDArray[np.float64],
    out: Path,
    name: str,
    config: SynthesizeConfig,
    *,
    seed: int,
    meta: Mapping[str, Any],
    noise: DepthNoise | None = None,
    tell: Callable[[int, str], None] = lambda done, text: None,
) -> None:
    """Record a simulated motion as the whole surface (OUT/NAME.npz) or with depth cameras (raw episode OUT/NAME).

    Args:
        nodes: [T, V, 3] node positions of the cloth at times [T].
        seed: seed of the recorder's noise.
        noise: noise of depth cameras, by default as in `config`.
        tell: called with (frames done, text).

    Raises:
        ConfigError: depth cameras would record several grippers, or the output folder has other files.
    """
    obstacles, faces = scenario.scene.surrounding.obstacles, system.mesh.faces
    if scenario.recorder == "whole_surface":
        obstacle = obstacles[0] if obstacles else None
        told = {**meta, "source": "synthetic"}
        episode = sample_surface(nodes, faces, times, obstacle, points=scenario.points, seed=seed, meta=told)
        write_episode(out / f"{name}.npz", episode)
        return
    if len(grippers := system.handles.grippers) > 1:
        raise ConfigError(
            f"Scenario {scenario.name} has the grippers {', '.join(grippers)}, but the recorder by depth cameras "
            "has one arm; choose recorder: whole_surface."
        )
    _replaceable(out / name, "synthetic")  # check before the recording starts
    height = float(obstacles[0].nodes[:, 2].max()) if obstacles else float(nodes[0, :, 2].min())
    motion = ClothMotion(nodes, faces, times, scenario.grasped, height)
    cameras = published_cameras(*config.image_size, noise=noise or DepthNoise(subpixel_px=config.subpixel_px))
    with staged(out / name) as folder:
        record(folder, motion, cameras, settings=config.recorder(), seed=seed, meta=meta, tell=tell)
        _clear(out / name, "synthetic")


def _replaceable(folder: Path, source: str) -> list[str]:
    """List the files of a recording that an earlier run left in a folder.

    Raises:
        ConfigError: the folder has something else.
    """
    if not folder.exists():
        return []
    own, others = raw_episode_files(folder)
    if "episode.json" not in own or read_description(folder).get("source") != source:
        raise ConfigError(f"{folder} exists and is no {source} recording; choose another --out, or move it away.")
    if others:
        raise ConfigError(f"{folder} holds other files ({', '.join(others[:5])}) that would be lost; move them away.")
    return own


def _clear(folder: Path, source: str) -> None:
    remove_files(folder, _replaceable(folder, source))
    with suppress(OSError):  # the folder does not exist, or has a hidden file of the system
        folder.rmdir()


def hidden_parameters(
    scenario: Scenario, config: SynthesizeConfig, rng: np.random.Generator
) -> dict[str, NDArray[np.float64]]:
    """Sample hidden multipliers: name -> [episodes].

    Scenarios with whole-surface recordings use the paper's distribution of simulated targets, uniform over the fit's
    bounds. For camera recordings, multipliers are log-uniform over the configured range.
    """
    if scenario.recorder == "whole_surface":
        low, high = np.transpose([scenario.bounds.get(name, PARAMETERS[name].bounds) for name in _HIDDEN])
        drawn = rng.uniform(low, high, (config.per_scenario, len(_HIDDEN)))  # independent of later rows
        return dict(zip(_HIDDEN, drawn.T, strict=True))
    low, high = np.log(config.true_range)
    return {name: np.exp(rng.uniform(low, high, config.per_scenario)) for name in _HIDDEN}
