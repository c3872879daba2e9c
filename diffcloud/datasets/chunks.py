"""A chunk of runs: the unit of work. What it gives depends on nothing but the chunk, on one type of processor.

Runs of a batch can differ in the last bits with the batch they are in and with the number of threads; so a chunk always
has the same runs, in one batch, on one thread.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from diffcloud.datasets.draws import ParameterDraws
from diffcloud.errors import DatasetError, DivergedError
from diffcloud.io.simulated import Split
from diffcloud.scene.scenarios import Scenario
from diffcloud.sim.simulate import rollout

CHUNK = 32
"""Runs simulated together: where time per run stops falling for cloths of 50 to 80 nodes on a CPU (docs/datasets.md)."""
_ATTEMPTS = 20
"""Draws of one run that may diverge."""


@dataclass(frozen=True)
class Chunk:
    """Runs `start` to `start + C - 1` of a split."""

    split: Split
    start: int
    parameters: NDArray[np.float64]
    """[C, k] as first drawn."""

    @property
    def name(self) -> str:
        return f"{self.split}-{self.start:06d}"


@dataclass(frozen=True)
class Replaced:
    """A draw whose simulation diverged."""

    run: int
    attempt: int
    parameters: tuple[float, ...]
    step: int
    reason: str


@dataclass(frozen=True)
class SimulatedChunk:
    """What a chunk gives."""

    parameters: NDArray[np.float64]
    """[C, k] that were simulated in the end."""
    nodes: NDArray[np.float32]
    """[C, T+1, V, 3] at each frame."""
    replaced: tuple[Replaced, ...]


def chunks_of(draws: ParameterDraws, split: Split, count: int) -> list[Chunk]:
    """The chunks of a split's runs."""
    parameters = draws.first(split, count)
    return [Chunk(split, start, parameters[start : start + CHUNK]) for start in range(0, count, CHUNK)]


def simulate_chunk(scenario: Scenario, draws: ParameterDraws, chunk: Chunk) -> SimulatedChunk:
    """Simulate a chunk; draws that diverge are replaced and the whole chunk is simulated again.

    Raises:
        DatasetError: a run diverged with 20 draws.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return _simulate(scenario, draws, chunk)
    finally:
        torch.set_num_threads(threads)


def _simulate(scenario: Scenario, draws: ParameterDraws, chunk: Chunk) -> SimulatedChunk:
    parameters = chunk.parameters.copy()
    attempts = np.zeros(len(parameters), dtype=int)
    replaced: list[Replaced] = []
    while True:
        try:
            return SimulatedChunk(parameters, _nodes(scenario, draws.box.names, parameters), tuple(replaced))
        except DivergedError as error:
            if not error.entries:
                raise DatasetError(f"Runs from {chunk.start} of {chunk.split}: {error}") from error
            for entry in sorted(set(error.entries)):  # rare
                run = chunk.start + entry
                replaced.append(
                    Replaced(run, int(attempts[entry]), tuple(parameters[entry].tolist()), error.step, error.reason)
                )
                attempts[entry] += 1
                if attempts[entry] == _ATTEMPTS:
                    raise DatasetError(
                        f"{chunk.split} run {run} of {scenario.name} diverged with {_ATTEMPTS} draws, the last at step "
                        f"{error.step}: {error.reason}. Try a smaller time step (steps_per_frame) or other parameters."
                    ) from error
                parameters[entry] = draws.again(chunk.split, run, int(attempts[entry]))


def _nodes(scenario: Scenario, names: tuple[str, ...], parameters: NDArray[np.float64]) -> NDArray[np.float32]:
    system, _ = scenario.scene.build()
    values = {name: torch.as_tensor(parameters[:, column]) for column, name in enumerate(names)}
    with torch.no_grad():
        run = rollout(system, scenario.steps, properties=scenario.properties(system, values))
    return run.positions[:, :: scenario.scene.frame_steps].to(torch.float32).numpy()
