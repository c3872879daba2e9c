"""On the published data (DIFFCLOUD_RELEASE): trajectories, imports, and a fit."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from diffcloud.fit import AdamSettings, FitSpace, Objective, fit_adam
from diffcloud.io.imports import release_episodes
from diffcloud.scene import load_scenario
from diffcloud.sim import rollout
from pipeline.acceptance import SCENES
from pipeline.config import FitConfig

# positions of the reference simulator (float32 prints) at given steps: scenario, (stretch, mass), step, node, position
REFERENCE = [
    ("release_lift", (1.0, 1.0), 1, 13, (0.002025, 0.303877, 0.222580)),
    ("release_lift", (1.0, 1.0), 1, 42, (0.002570, -0.789504, 0.174770)),
    ("release_lift", (1.0, 1.0), 1, 19, (0.002365, -0.070805, 0.176244)),
    ("release_fold", (1.0, 1.0), 1, 42, (0.002168, -0.816366, 0.286810)),
    ("release_fold", (1.0, 1.0), 1, 13, (0.001969, 0.302954, 0.177489)),
    ("release_band", (0.48085162, 5.81268967), 5, 36, (0.119720, -0.050859, 0.631781)),
]


def scenario_of(release, name):
    return load_scenario(name, release / "conf" / "rigidcloth" / SCENES[name])


def simulate(scenario, stretch, mass, steps):
    system, _ = scenario.scene.build()
    values = {name: torch.tensor([v], dtype=torch.float64) for name, v in (("stretch", stretch), ("mass", mass))}
    with torch.no_grad():
        return rollout(system, steps, properties=scenario.properties(system, values)).positions[0].numpy()


@pytest.mark.parametrize(("name", "parameters", "step", "node", "expected"), REFERENCE)
def test_positions_before_contact_are_the_reference_simulators(release, name, parameters, step, node, expected):
    # the first band run of a process lags by a step in its stored normals (up to 1.6 mm), which is not reproduced
    tolerance = 1e-3 if name == "release_band" else 2e-6
    found = simulate(scenario_of(release, name), *parameters, step)[step, node]
    np.testing.assert_allclose(found, expected, atol=tolerance)


@pytest.mark.parametrize("name", SCENES)
def test_every_published_scene_runs(release, name):
    scenario = scenario_of(release, name)
    assert np.isfinite(simulate(scenario, 1.0, 1.0, scenario.steps)).all()


def test_every_published_episode_is_imported(release):
    found = list(release_episodes(release))
    scenarios = {scenario for scenario, _, _ in found}
    assert scenarios <= {"release_lift", "release_fold", "release_band", "release_hang"}
    for scenario, name, episode in found:
        assert np.isfinite(episode.points).all(), (scenario, name)
        if scenario in ("release_lift", "release_fold"):
            assert episode.frame_count == 25
            assert set(episode.meta["predictions"]) == {"mlp", "pointnet2", "meteornet"}
        else:
            assert set(episode.meta["truth"]) == {"stretch", "mass"}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["lift", "fold"])
def test_a_single_start_fit_beats_every_published_prediction(release, kind):
    name = f"release_{kind}"
    scenario = scenario_of(release, name)
    label, episode = next((n, e) for s, n, e in release_episodes(release) if s == name)
    objective = Objective(scenario, [episode])
    space = FitSpace.build(["stretch", "mass"], bounds=scenario.bounds)
    outcome = fit_adam(
        objective, space, AdamSettings(learning_rate=scenario.learning_rate, smoothing=FitConfig().smoothing)
    )
    pairs = episode.meta["predictions"].values()
    values = {key: torch.tensor([np.clip(pair[key], 0.1, 10) for pair in pairs]) for key in space.names}
    with torch.no_grad():
        published = objective(values)
    assert outcome.loss < outcome.loss_start
    assert outcome.loss <= float(published.min()), label
