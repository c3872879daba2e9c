"""The first start of a fit: given by the user, or predicted by a network."""

from __future__ import annotations

from pathlib import Path

from diffcloud.console import assignments
from diffcloud.errors import ConfigError
from diffcloud.estimation.task import FitTask
from diffcloud.io.episodes import Episode
from diffcloud.regressors import MODEL_NAMES, Regressor, predict_episode

REGRESSORS = Path("data/regressors")
"""Folder of the pipeline's checkpoints: <scenario>/<model>.safetensors."""


def first_start(init: str, task: FitTask) -> dict[str, float]:
    """Return the multipliers of the first start, from values in SI units or from a network's predictions.

    In a joint fit, the predictions are averaged over the recordings.

    Raises:
        ConfigError: a value belongs to a parameter that is not fitted, or is out of bounds.
    """
    if "=" in init:
        stated = task.scenario.multipliers(assignments(init.split(","), "--init"), "--init")
        task.space.check_start(stated, task.scenario.nominal)
        return stated
    found = [predicted_start(init, one.scenario.name, one.episode) for one in task.recordings]
    return task.space.nearest({name: sum(values[name] for values in found) / len(found) for name in found[0]})


def predicted_start(name: str, scenario: str, episode: Episode) -> dict[str, float]:
    """Predict parameter values within the bounds, as the start of a fit.

    Args:
        name: a model name, for the pipeline's own checkpoint of the scenario, or the path of a checkpoint.

    Raises:
        ConfigError, CheckpointError, EpisodeError: the checkpoint does not exist or belongs to another scenario, or the
            episode lacks frames that the network needs.
    """
    path = REGRESSORS / scenario / f"{name}.safetensors" if name in MODEL_NAMES else Path(name)
    if name not in MODEL_NAMES and not path.is_file():
        raise ConfigError(
            f"A start is middle, PARAMETER=VALUE,..., {', '.join(MODEL_NAMES)} or a checkpoint, got {name!r}."
        )
    regressor = Regressor.read(path)
    if regressor.description.scenario != scenario:
        raise ConfigError(f"{path} was trained for {regressor.description.scenario}, not for {scenario}.")
    prediction = predict_episode(regressor, episode)
    return dict(zip(prediction.names, prediction.clipped[0].tolist(), strict=True))
