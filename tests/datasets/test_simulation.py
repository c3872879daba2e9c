"""Simulated sets: the same bytes however they ran, replacements of diverged draws, folders that are left alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from diffcloud.clouds import Augmentation
from diffcloud.datasets import CHUNK, ParameterBox, ParameterDraws, SimulationPlan, chunks, simulate_set, work
from diffcloud.errors import ConfigError, DatasetError, DivergedError
from diffcloud.io import arrays
from diffcloud.io.simulated import SimulatedSet
from diffcloud.regressors.dataset import CloudDataset
from diffcloud.sim.simulate import rollout
from diffcloud.sim.threads import use_threads
from tests.conftest import small_lift

BOX = ParameterBox.build(["stretching", "density"])


def plan(*, train=CHUNK + 4, test=3, seed=0, scenario=None) -> SimulationPlan:
    scenario = scenario or small_lift()
    return SimulationPlan(scenario, ParameterDraws(BOX, "uniform", scenario.name, seed), {"train": train, "test": test})


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """The set of `plan()`, simulated in one go in this process."""
    out = tmp_path_factory.mktemp("whole") / "set"
    simulate_set(plan(), out, workers=0)
    return out


class Stop(Exception):
    pass


def stop_after(count: int):
    def progress(finished: int) -> None:
        if finished >= count:
            raise Stop

    return progress


def test_runs_are_those_of_a_plain_rollout(whole):
    scenario = small_lift()
    read = SimulatedSet.read(whole, "train")
    system, _ = scenario.scene.build()
    values = {name: torch.as_tensor(read.parameters[CHUNK:, i]) for i, name in enumerate(read.names)}
    run = rollout(system, scenario.steps, properties=scenario.properties(system, values))
    expected = run.positions[:, :: scenario.scene.frame_steps].to(torch.float32)
    np.testing.assert_array_equal(read.nodes[CHUNK:], expected.numpy())
    assert read.nodes.shape == (CHUNK + 4, scenario.frames + 1, 25, 3)
    assert read.loss_frame == scenario.frames
    np.testing.assert_allclose(read.times, run.times[:: scenario.scene.frame_steps])
    assert read.obstacle is None  # the table is not rendered


def test_uncertain_material_of_a_run_is_simulated():
    uncertain = {"bending": 2.0, "friction": 1.5, "body_mass": 1.5}
    scenario = small_lift()
    assert scenario.value("bending") == 1.0
    assert scenario.value("friction") > 0
    assert scenario.value("body_mass") == 0.0  # there are none, and nothing is drawn
    draws = ParameterDraws(ParameterBox.build(["stretching", "density"]), "uniform", scenario.name, 0, uncertain)
    (chunk,) = chunks.chunks_of(draws, "test", 3)
    found = chunks.simulate_chunk(scenario, draws, chunk)
    system, _ = scenario.scene.build()
    factors = [draws.uncertain_factors("test", run, 0) for run in range(3)]
    values = dict(zip(("stretching", "density"), torch.as_tensor(found.parameters.T), strict=True))
    for name in ("bending", "friction"):
        values[name] = torch.tensor([scenario.value(name) * one[name] for one in factors], dtype=torch.float64)
    run = rollout(system, scenario.steps, properties=scenario.properties(system, values))
    expected = run.positions[:, :: scenario.scene.frame_steps].to(torch.float32)
    np.testing.assert_array_equal(found.nodes, expected.numpy())


def test_uncertain_material_stays_possible(monkeypatch):
    """Of a compression a little below one, which is the most there is."""
    plain, drawn = small_lift(), []
    scenario = replace(plain, scene=replace(plain.scene, material=replace(plain.scene.material, compression=0.9)))
    nodes = np.zeros((8, scenario.frames + 1, 25, 3), np.float32)
    monkeypatch.setattr(chunks, "_nodes", lambda scenario, values: drawn.append(values) or (nodes, {}))
    draws = ParameterDraws(BOX, "uniform", scenario.name, 0, {"compression": 1.5})
    (chunk,) = chunks.chunks_of(draws, "test", 8)
    chunks.simulate_chunk(scenario, draws, chunk)
    found = drawn[0]["compression"]
    assert found.max() == 1.0
    assert found.min() < 1.0


def test_chunks_may_be_as_large_as_sets(tmp_path, monkeypatch):
    asked, whole = [], plan()
    (chunk,) = chunks.chunks_of(whole.draws, "test", 3)
    folder = work.WorkFolder(tmp_path / "set", "plan", [chunk])
    monkeypatch.setattr(work, "read_npz", lambda *a, most_bytes=arrays.MOST_BYTES, **k: asked.append(most_bytes) or {})
    folder.read(chunk)
    assert asked == [16 * 2**30]


def test_a_chunk_keeps_no_derivatives(monkeypatch):
    runs = []
    monkeypatch.setattr(chunks, "rollout", lambda *a, **k: runs.append(rollout(*a, **k)) or runs[-1])
    whole = plan()
    chunks.simulate_chunk(whole.scenario, whole.draws, chunks.chunks_of(whole.draws, "test", 3)[0])
    assert runs[0].positions.grad_fn is None


def test_threads_change_no_bytes():
    found, whole = [], plan()
    chunk = chunks.chunks_of(whole.draws, "test", 3)[0]
    try:
        for threads in (1, 2, 5):
            use_threads(threads)
            found.append(chunks.simulate_chunk(whole.scenario, whole.draws, chunk).nodes.tobytes())
    finally:
        use_threads(None)
    assert len(set(found)) == 1


def test_an_interrupted_set_ends_with_the_same_bytes_and_redoes_nothing(whole, tmp_path, monkeypatch):
    out = tmp_path / "set"
    with pytest.raises(Stop):
        simulate_set(plan(), out, workers=0, progress=stop_after(CHUNK))
    assert not out.exists()
    (damaged := tmp_path / "set.partial" / f"train-{CHUNK:06d}.npz").write_bytes(b"half")
    assert damaged.exists()
    simulated = []
    monkeypatch.setattr(chunks, "rollout", lambda *a, **k: simulated.append(k["properties"].batch) or rollout(*a, **k))
    outcome = simulate_set(plan(), out, workers=0)
    assert outcome.resumed == CHUNK
    assert sorted(simulated) == [3, 4]
    assert contents(out) == contents(whole)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".set.timings.json", "set"]


def test_a_kill_while_joining_loses_nothing(whole, tmp_path, monkeypatch):
    out = tmp_path / "set"
    simulate_set(plan(seed=1), out, workers=0)
    former = contents(out)

    def fail(*arguments, **options):
        raise Stop

    with monkeypatch.context() as patch:
        patch.setattr("diffcloud.datasets.simulation.write_simulated", fail)
        with pytest.raises(Stop):
            simulate_set(plan(), out, workers=0)
    assert contents(out) == former
    outcome = simulate_set(plan(), out, workers=0)
    assert outcome.resumed == CHUNK + 7
    assert contents(out) == contents(whole)


def test_chunks_of_another_plan_are_not_used(whole, tmp_path):
    out = tmp_path / "set"
    for other in (plan(seed=1), plan(scenario=small_lift(gravity=(0, 0, -9.0)))):
        with pytest.raises(Stop):
            simulate_set(other, out, workers=0, progress=stop_after(CHUNK))
        outcome = simulate_set(plan(), out, workers=0)
        assert (outcome.resumed, outcome.discarded) == (0, True)
        assert contents(out) == contents(whole)


def diverging(*doomed: float):
    """A rollout that diverges wherever the stretching multiplier is one of these."""

    def run(system, steps, *, properties, drop_diverged):
        assert drop_diverged
        bad = [entry for entry, value in enumerate(properties.stretching[:, 0].tolist()) if value in doomed]
        found = rollout(system, steps, properties=properties)
        found.positions[bad, 3:] = torch.nan
        return replace(found, diverged={entry: DivergedError(3, [entry], "on purpose") for entry in bad})

    return run


def test_diverged_draws_are_recorded_and_replaced(whole, tmp_path, monkeypatch):
    draws = plan().draws
    first = draws.first("train", CHUNK + 4)
    doomed = [first[2, 0], draws.again("train", 2, 1)[0], first[CHUNK + 1, 0]]  # run 2 fails twice
    monkeypatch.setattr(chunks, "rollout", diverging(*doomed))
    for out in (tmp_path / "a", tmp_path / "b"):
        outcome = simulate_set(plan(), out, workers=0)
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    assert [(entry.run, entry.attempt) for entry in outcome.replaced["train"]] == [(2, 0), (2, 1), (CHUNK + 1, 0)]
    table = pd.read_csv(tmp_path / "a" / "replaced.csv")
    assert table[["split", "run", "attempt", "step", "reason"]].to_numpy().tolist() == [
        ["train", 2, 0, 3, "on purpose"], ["train", 2, 1, 3, "on purpose"], ["train", CHUNK + 1, 0, 3, "on purpose"],
    ]  # fmt: skip
    np.testing.assert_allclose(table["stretching"], doomed, rtol=1e-12)
    expected = first.copy()
    expected[2], expected[CHUNK + 1] = draws.again("train", 2, 2), draws.again("train", CHUNK + 1, 1)
    train = SimulatedSet.read(tmp_path / "a", "train")  # which refuses NaN
    np.testing.assert_array_equal(train.parameters, expected)
    same = np.flatnonzero((expected == first).all(axis=1))
    np.testing.assert_array_equal(train.nodes[same], SimulatedSet.read(whole, "train").nodes[same])
    test, before = (SimulatedSet.read(folder, "test") for folder in (tmp_path / "a", whole))
    np.testing.assert_array_equal(test.nodes, before.nodes)  # nobody else changes


def test_a_run_that_always_diverges_is_an_error(tmp_path, monkeypatch):
    doomed = [plan().draws.first("train", 1)[0, 0], *(plan().draws.again("train", 0, n)[0] for n in range(1, 20))]
    monkeypatch.setattr(chunks, "rollout", diverging(*doomed))
    with pytest.raises(DatasetError, match=r"train run 0 .* diverged with 20 draws, the last at step 3: on purpose"):
        simulate_set(plan(), tmp_path / "set", workers=0)
    assert not (tmp_path / "set").exists()


def test_exported_clouds_are_those_of_the_first_epoch(tmp_path):
    """Of either split, which a training gives random numbers of their own."""
    simulate_set(plan(train=2, test=2, seed=5), tmp_path / "set", workers=0, clouds=50)
    for split, seed in (("train", 5), ("test", 6)):
        simulated = SimulatedSet.read(tmp_path / "set", split)
        clouds, _ = CloudDataset(simulated, Augmentation(), frames="all", points=50, seed=seed)[1]
        folder = tmp_path / "set" / "clouds" / split / "1"
        assert [path.name for path in sorted(folder.iterdir())] == [f"{frame:03d}.npy" for frame in range(len(clouds))]
        for frame, cloud in enumerate(clouds):
            np.testing.assert_array_equal(np.load(folder / f"{frame:03d}.npy"), cloud.numpy())


def test_a_folder_of_other_things_is_left_alone(tmp_path):
    (tmp_path / "precious.txt").write_text("mine")
    with pytest.raises(ConfigError, match="holds something else than a simulated set"):
        simulate_set(plan(), tmp_path, workers=0)
    assert (tmp_path / "precious.txt").read_text() == "mine"


def test_a_set_needs_runs():
    with pytest.raises(ConfigError, match="at least one run"):
        plan(train=0, test=0)
