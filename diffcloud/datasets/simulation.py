"""Simulate a whole set: sample parameters, simulate them in chunks, join and write the results."""

from __future__ import annotations

import logging
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from diffcloud.clouds.augmentation import Augmentation, CloudMaker, run_keys
from diffcloud.datasets.chunks import Chunk, Replaced, SimulatedChunk, chunks_of, simulate_chunk
from diffcloud.datasets.draws import ParameterDraws
from diffcloud.datasets.work import WorkFolder
from diffcloud.errors import ConfigError, DatasetError, DiffCloudError
from diffcloud.io.files import atomic
from diffcloud.io.simulated import SPLITS, SimulatedSet, Split, write_simulated
from diffcloud.io.timings import write_timings
from diffcloud.scene.scenarios import Scenario
from diffcloud.sim.threads import use_threads

_WORKER_MEMORY = {
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": str(1 << 30),
    "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": str(1 << 25),
}
"""Dask settings that let worker processes keep freed memory. By default they return blocks above 64 KiB to the system,
and spend a quarter of the time on allocating them again."""


@dataclass(frozen=True)
class SimulationPlan:
    """Everything that determines the contents of a set, for one type of processor.

    Raises:
        ConfigError: there are no runs.
    """

    scenario: Scenario
    draws: ParameterDraws
    counts: Mapping[Split, int]

    def __post_init__(self) -> None:
        if sum(self.counts.values()) < 1 or min(self.counts.values()) < 0:
            raise ConfigError(f"A set needs at least one run, got {dict(self.counts)}.")


@dataclass(frozen=True)
class SimulationOutcome:
    """Summary of a call of `simulate_set`."""

    resumed: int
    """Number of runs that an earlier, interrupted call had finished."""
    replaced: dict[Split, list[Replaced]]
    discarded: bool
    """Whether chunks of another plan were found and removed."""
    seconds: float
    """Wall time of this call [s]."""


def simulate_set(
    plan: SimulationPlan,
    out: Path,
    *,
    workers: int = 0,
    client: Any = None,
    clouds: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> SimulationOutcome:
    """Simulate a set into a folder. The set is written when it is complete, with its wall time beside it
    (`io.timings`).

    Finished chunks are stored in `<out>.partial`, and reused by the next call with the same plan.

    Args:
        workers: number of local processes with one thread each. 0: the threads of this process.
        client: client of a Dask scheduler, whose workers need the same package version. It replaces `workers`.
        clouds: number of points of each exported cloud. None: export no clouds.
        progress: called with the number of finished runs.

    Raises:
        ConfigError: the folder has other contents.
        DatasetError: a run diverges with all samples, or workers died.
        DiffCloudError: the folder is not writable.
    """
    began = time.perf_counter()
    chunks = [chunk for split, count in plan.counts.items() for chunk in chunks_of(plan.draws, split, count)]
    work = WorkFolder(out, [plan.scenario, plan.draws, dict(plan.counts)], chunks)
    missing = [chunk for chunk in chunks if work.read(chunk) is None]
    finished = resumed = sum(len(chunk.parameters) for chunk in chunks) - sum(len(c.parameters) for c in missing)
    if progress is not None:
        progress(finished)
    for chunk, result in _simulated(plan, missing, workers, client):
        work.write(chunk, result)
        finished += len(chunk.parameters)
        if progress is not None:
            progress(finished)
    results: dict[Split, list[SimulatedChunk]] = {split: [] for split, count in plan.counts.items() if count}
    for chunk in chunks:
        kept = work.read(chunk)
        if kept is None:
            raise DatasetError(f"{work.path} lost the runs {chunk.name}; was it cleared? Run the command again.")
        results[chunk.split].append(kept)
    replaced = {split: [entry for part in parts for entry in part.replaced] for split, parts in results.items()}
    outcome = SimulationOutcome(resumed, replaced, work.discarded, time.perf_counter() - began)

    def write(folder: Path) -> list[str]:
        # Write it beside the set, because the set itself should have the same bytes in each run.
        write_timings(folder, outcome.seconds, resumed=resumed)
        return _write(folder, plan, results, clouds)

    work.publish(write)
    return outcome


def _simulated(
    plan: SimulationPlan, chunks: Sequence[Chunk], workers: int, client: Any
) -> Iterator[tuple[Chunk, SimulatedChunk]]:
    """Yield chunks with their results, in order of completion."""
    if not chunks:
        return
    if client is None and not workers:
        for chunk in chunks:
            yield chunk, simulate_chunk(plan.scenario, plan.draws, chunk)
        return
    from distributed import as_completed

    with ExitStack() as stack:
        if client is None:
            client = stack.enter_context(_local_client(min(workers, len(chunks))))
        futures = {client.submit(simulate_chunk, plan.scenario, plan.draws, chunk, pure=False): chunk for chunk in chunks}
        done = as_completed(futures, with_results=True)
        while True:
            # Dask raises many types of errors if workers are gone. Errors of a chunk itself are DiffCloudErrors.
            try:
                future, result = next(done)
            except StopIteration:
                return
            except DiffCloudError:
                raise
            except Exception as error:
                raise _workers_lost(error) from error
            yield futures[future], result
            future.release()


@contextmanager
def _local_client(workers: int) -> Iterator[Any]:
    """Yield a Dask client of processes on this machine."""
    import dask  # slow to import
    from distributed import Client, LocalCluster

    with ExitStack() as stack:
        try:
            with dask.config.set(_WORKER_MEMORY):
                cluster = LocalCluster(
                    n_workers=workers,
                    threads_per_worker=1,
                    dashboard_address=":0",  # any free port, so that two calls at once do not conflict
                    silence_logs=logging.CRITICAL,
                )
            stack.enter_context(cluster)
            client = stack.enter_context(Client(cluster))
            client.run(_ignore_ctrl_c)
        except Exception as error:  # a worker died during its start
            raise _workers_lost(error) from error
        yield client


def _workers_lost(error: Exception) -> DatasetError:
    return DatasetError(
        f"Worker processes ended without a word ({type(error).__name__}: {error}), as those do that get no more memory or "
        "are killed. Finished runs are kept; run the command again, perhaps with fewer --workers."
    )


def _ignore_ctrl_c() -> None:
    """Set up a worker: ignore Ctrl-C, because the parent process stops it, and use one thread."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    use_threads(1)


def _write(
    folder: Path, plan: SimulationPlan, results: Mapping[Split, Sequence[SimulatedChunk]], clouds: int | None
) -> list[str]:
    sets = {split: _joined(plan, parts) for split, parts in results.items()}
    about = {
        "draws": plan.draws.kind,
        "seed": plan.draws.seed,
        "uncertain": {name: factor for name, factor in plan.draws.uncertain.items() if plan.scenario.value(name)},
        "integrator": plan.scenario.scene.integrator,
        "replaced": sum(len(part.replaced) for parts in results.values() for part in parts),
        "clouds": clouds or 0,
    }
    names = []
    for split, simulated in sets.items():
        if clouds is None:
            break
        seed = plan.draws.seed + SPLITS.index(split)  # different noise in both splits
        written = export_clouds(folder / "clouds" / split, simulated, points=clouds, seed=seed)
        names += [f"clouds/{split}/{name}" for name in written]
    return names + write_simulated(folder, sets, about=about, replaced=_replaced_table(plan, results))


def _joined(plan: SimulationPlan, parts: Sequence[SimulatedChunk]) -> SimulatedSet:
    scenario, scene = plan.scenario, plan.scenario.scene
    first_frame = round(scenario.first_frame_time / scene.frame_time)
    frame = scenario.loss_frames[0]
    bodies = scene.bodies
    return SimulatedSet(
        scenario=scenario.name,
        names=plan.draws.box.names,
        bounds=plan.draws.box.bounds,
        parameters=np.concatenate([part.parameters for part in parts]),
        nodes=np.concatenate([part.nodes for part in parts]),
        times=np.arange(scenario.frames + 1, dtype=np.float64) * scene.frame_time,
        faces=scene.mesh.faces,
        loss_faces=scenario.loss_faces,
        loss_frame=first_frame + frame if frame >= 0 else scenario.frames + 1 + frame,
        first_frame=first_frame,
        obstacle=bodies if len(bodies.faces) else None,
        length_unit_m=scenario.length_unit_m,
    )


def _replaced_table(plan: SimulationPlan, results: Mapping[Split, Sequence[SimulatedChunk]]) -> str:
    rows = [
        [split, entry.run, entry.attempt, *entry.parameters, entry.step, entry.reason]
        for split, parts in results.items()
        for part in parts
        for entry in part.replaced
    ]
    columns = ["split", "run", "attempt", *plan.draws.box.names, "step", "reason"]
    return pd.DataFrame(rows, columns=columns).to_csv(index=False, lineterminator="\n")


def export_clouds(folder: Path, simulated: SimulatedSet, *, points: int, seed: int) -> list[str]:
    """Write the clouds of all runs and frames as `<run>/<frame>.npy` float32 [points, 3], and return the file names.

    This is the folder layout of the published data. The clouds are those of the first training epoch with all frames,
    the same seed and number of points, and default augmentation.
    """
    maker = CloudMaker.build(simulated, Augmentation(), points=points)
    names = []
    for run, nodes in enumerate(simulated.nodes):  # one run at a time, because its clouds have megabytes
        clouds = maker.clouds(torch.as_tensor(nodes[None]), run_keys(seed, 0, torch.tensor([run])))[0].numpy()
        for frame, cloud in enumerate(clouds):
            names.append(f"{run}/{frame:03d}.npy")
            with atomic(folder / names[-1]) as stream:
                np.save(stream, cloud, allow_pickle=False)
    return names
