"""`diffcloud network predict`: parameters of recorded episodes by a trained network, in milliseconds."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import typer

from diffcloud.cli.options import JsonFlag
from diffcloud.console import episode_files, errors, finish, show, with_suffix


def predict(
    episodes: Annotated[list[Path], typer.Argument(help="Episode files, or folders of them.")],
    checkpoint: Annotated[Path, typer.Option(help="Written by `diffcloud network train`.")],
    level: Annotated[float, typer.Option(min=0.01, max=0.99, help="Probability of the intervals shown.")] = 0.9,
    seed: Annotated[int, typer.Option(min=0, help="Of the choice of points.")] = 0,
    samples: Annotated[
        Path | None, typer.Option(help="CSV for what is drawn from a posterior: episode, and a column for each parameter.")
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Predict the parameters of episodes. Values outside the bounds are shown as they are, and said to be outside."""
    import pandas as pd
    from rich.table import Table

    from diffcloud.errors import ConfigError, EpisodeError
    from diffcloud.io.episodes import read_episode
    from diffcloud.io.files import write_text
    from diffcloud.regressors import Regressor, predict_episode
    from diffcloud.sim.properties import PARAMETERS

    regressor = Regressor.read(checkpoint)
    if samples is not None and regressor.description.model != "posterior":
        raise ConfigError(f"--samples needs a posterior; {checkpoint} is a {regressor.description.model}, which has none.")
    drawn: list[pd.DataFrame] = []
    names = regressor.description.names
    found: dict[str, dict[str, Any]] = {}
    outside: list[str] = []
    seconds = []
    heads = (name if PARAMETERS[name].quantity is None else f"{name}, × nominal" for name in names)
    table = Table("episode", *heads, f"{100 * level:.0f} % interval")
    for path in episode_files(episodes):
        episode = read_episode(path)
        began = time.perf_counter()
        try:
            prediction = predict_episode(regressor, episode, seed=seed)
        except EpisodeError as error:
            raise EpisodeError(f"{path}: {error}") from error
        seconds.append(time.perf_counter() - began)
        if samples is not None and prediction.samples is not None:
            told = pd.DataFrame(prediction.samples[0].numpy(), columns=list(names))
            told.insert(0, "episode", path.stem)
            drawn.append(told)
        values = dict(zip(names, prediction.values[0].tolist(), strict=True))
        inside = dict(zip(names, prediction.inside[0].tolist(), strict=True))
        beyond = [name for name in names if not inside[name]]
        outside += [f"{path.stem}: {name} {values[name]:.3g}" for name in beyond]
        clipped = dict(zip(names, prediction.clipped[0].tolist(), strict=True))
        interval = prediction.first_intervals(level)
        found[path.stem] = {**values, "outside": beyond, "clipped": clipped, "interval": interval}
        ranges = ", ".join(f"{name} {low:.2f} to {high:.2f}" for name, (low, high) in interval.items())
        table.add_row(path.stem, *(f"{value:.3f}{'' if inside[name] else ' !'}" for name, value in values.items()), ranges)
    if samples is not None:
        write_text(with_suffix(samples, ".csv"), pd.concat(drawn).to_csv(index=False))
    show(table, json)
    if outside:
        bounds = ", ".join(f"{n} {list(b)}" for n, b in zip(names, regressor.description.bounds, strict=True))
        errors.print(f"Outside the bounds ({bounds}), clipped only for a simulation: {'; '.join(outside)}.")
    if not json:
        errors.print(f"{1e3 * sorted(seconds)[len(seconds) // 2]:.0f} ms an episode.")
    finish(found, json)
