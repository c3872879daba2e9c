"""A chunk of runs, the unit of parallel work. Its result depends only on the chunk, for one type of processor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from diffcloud.datasets.draws import ParameterDraws
from diffcloud.errors import DatasetError, DivergedError
from diffcloud.io.simulated import Split
from diffcloud.scene.scenarios import Scenario
from diffcloud.sim.properties import PARAMETERS
from diffcloud.sim.simulate import rollout

CHUNK = 32
"""Number of runs simulated together. Larger chunks are no faster per run for 50 to 80 nodes on a CPU
(docs/datasets.md)."""
_ATTEMPTS = 20
"""Largest number of parameter samples for a run that diverges."""


@dataclass(frozen=True)
class Chunk:
    """Runs `start` to `start + C - 1` of a split."""

    split: Split
    start: int
    parameters: NDArray[np.float64]
    """[C, k] initial parameter samples."""

    @property
    def name(self) -> str:
        return f"{self.split}-{self.start:06d}"


@dataclass(frozen=True)
class Replaced:
    """A parameter sample whose simulation diverged."""

    run: int
    attempt: int
    parameters: tuple[float, ...]
    step: int
    reason: str


@dataclass(frozen=True)
class SimulatedChunk:
    """Result of a chunk."""

    parameters: NDArray[np.float64]
    """[C, k] final parameters, after diverged samples were replaced."""
    nodes: NDArray[np.float32]
    """[C, T+1, V, 3] node positions at each frame."""
    replaced: tuple[Replaced, ...]


def chunks_of(draws: ParameterDraws, split: Split, count: int) -> list[Chunk]:
    """Split the runs of a split into chunks."""
    parameters = draws.first(split, count)
    return [Chunk(split, start, parameters[start : start + CHUNK]) for start in range(0, count, CHUNK)]


def simulate_chunk(scenario: Scenario, draws: ParameterDraws, chunk: Chunk) -> SimulatedChunk:
    """Simulate a chunk. Runs that diverge are simulated again with new parameters, as a separate batch.

    Raises:
        DatasetError: a run diverged with all of its 20 parameter samples.
    """
    parameters = chunk.parameters.copy()
    nodes = np.empty((len(parameters), scenario.frames + 1, len(scenario.scene.mesh.nodes), 3), dtype=np.float32)
    missing, replaced = np.arange(len(parameters)), list[Replaced]()
    for attempt in range(_ATTEMPTS):
        try:
            values = dict(zip(draws.box.names, parameters[missing].T, strict=True))
            runs = [chunk.start + int(entry) for entry in missing]
            factors = [draws.uncertain_factors(chunk.split, run, attempt) for run in runs]
            for name in draws.uncertain:
                if value := scenario.value(name):
                    values[name] = np.minimum(value * np.array([one[name] for one in factors]), PARAMETERS[name].most)
            nodes[missing], diverged = _nodes(scenario, values)
        except DivergedError as error:
            raise DatasetError(f"Runs from {chunk.start} of {chunk.split}: {error}") from error
        missing = missing[sorted(diverged)]
        for entry, (_, failure) in zip(missing, sorted(diverged.items()), strict=True):  # rare
            run = chunk.start + int(entry)
            replaced.append(Replaced(run, attempt, tuple(parameters[entry].tolist()), failure.step, failure.reason))
            parameters[entry] = draws.again(chunk.split, run, attempt + 1)
        if not len(missing):
            return SimulatedChunk(parameters, nodes, tuple(sorted(replaced, key=lambda one: (one.run, one.attempt))))
    raise DatasetError(
        f"{chunk.split} run {replaced[-1].run} of {scenario.name} diverged with {_ATTEMPTS} draws, the last at step "
        f"{replaced[-1].step}: {replaced[-1].reason}. Try a smaller time step (steps_per_frame) or other parameters."
    )


def _nodes(
    scenario: Scenario, values: Mapping[str, NDArray[np.float64]]
) -> tuple[NDArray[np.float32], Mapping[int, DivergedError]]:
    """Simulate runs with parameters name -> [b]. Return nodes [b, T+1, V, 3], and the errors of diverged runs."""
    system, _ = scenario.scene.build()
    properties = scenario.properties(system, {name: torch.as_tensor(value) for name, value in values.items()})
    with torch.no_grad():
        run = rollout(system, scenario.steps, properties=properties, drop_diverged=True)
    return run.positions[:, :: scenario.scene.frame_steps].to(torch.float32).numpy(), run.diverged
