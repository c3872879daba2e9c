"""How often the simulator's derivatives agree with finite differences at random parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import pandas as pd
import typer
from numpy.typing import NDArray
from rich.table import Table

from diffcloud.cli.options import JsonFlag, SceneName, Threads
from diffcloud.console import finish, progress_bar, show, writes
from diffcloud.errors import ConfigError
from diffcloud.io.files import write_text
from diffcloud.io.fingerprints import fingerprint
from diffcloud.jobs.scenarios import scene_named
from diffcloud.sim.threads import use_threads
from studies.gradient_agreement import NAMES, Agreement, gradient_agreement, random_parameters

_COLUMNS = [f"{kind}{name}" for kind in ("", "gradient_", "difference_") for name in NAMES]
_OF = ["scenario", "integrator", "simulator"]
"""Columns that tell what was simulated, and by what."""


@writes(".csv")
def gradients(
    scene: SceneName = "lift",
    integrator: Annotated[Literal["implicit", "arcsim"] | None, typer.Option(help="Instead of the scenario's own.")] = None,
    pairs: Annotated[
        int, typer.Option(min=1, max=100_000, help="Random (stretching, density), uniform over their bounds.")
    ] = 50,
    seed: Annotated[int, typer.Option(min=0, help="Of the pairs.")] = 0,
    out: Annotated[Path | None, typer.Option(help="CSV of all pairs; an existing one is continued.")] = None,
    threads: Threads = None,
    json: JsonFlag = False,
) -> None:
    """Sign and size of d loss/d parameter against the central difference of ±1 %; the loss is the mean squared node
    distance at the loss frame to the run at (1, 1)."""
    use_threads(threads)
    chosen = scene_named(scene or "lift")
    if integrator is not None:
        chosen = replace(chosen, scene=chosen.scene.stepped(integrator))
    drawn = random_parameters(chosen, pairs, seed=seed)
    mark = fingerprint([chosen], packages=("mesh", "scene", "sim"))[:16]
    simulated = {"scenario": chosen.name, "integrator": chosen.scene.integrator, "simulator": mark}
    done = _read(out, drawn, simulated)
    with progress_bar("gradients", pairs) as update:
        update(len(done), "")
        for found in gradient_agreement(chosen, drawn[len(done) :]):
            done = np.concatenate([done, np.hstack([found.parameters, found.gradient, found.difference])])
            if out is not None:
                write_text(out, pd.DataFrame(done, columns=_COLUMNS).assign(**simulated).to_csv(index=False))
            update(len(done), "")
    agreement = Agreement(*np.split(done[:pairs], 3, axis=1))
    table = Table("parameter", "pairs", "sign %", "within a factor of 2, %")
    shares = {}
    for index, name in enumerate(NAMES):
        shares[name] = {
            "sign": float(agreement.same_sign[:, index].mean()),
            "within_factor_2": float(agreement.same_size[:, index].mean()),
        }
        table.add_row(name, str(pairs), *(f"{100 * share:.0f}" for share in shares[name].values()))
    show(table, json)
    finish({**simulated, "pairs": pairs, "shares": shares}, json)


def _read(path: Path | None, drawn: NDArray[np.float64], simulated: Mapping[str, str]) -> NDArray[np.float64]:
    """[n, 6] rows of an earlier run of the same pairs."""
    if path is None or not path.exists():
        return np.empty((0, len(_COLUMNS)))
    try:
        table = pd.read_csv(path)
        rows = table[_COLUMNS].to_numpy(dtype=np.float64)
        others = table[_OF].drop_duplicates().to_dict("records")
    except (OSError, ValueError, KeyError) as error:
        raise ConfigError(
            f"{path} is not a table that `python -m studies gradients` wrote: {error}. Choose another --out."
        ) from error
    common = min(len(rows), len(drawn))
    if others not in ([], [dict(simulated)]):
        told = "; ".join(" ".join(map(str, one.values())) for one in others)
        raise ConfigError(
            f"{path} holds pairs of {told}, not of {' '.join(simulated.values())} (scenario, integrator, and a mark of "
            "both and the simulator's code). Choose another --out."
        )
    if not np.allclose(rows[:common, : len(NAMES)], drawn[:common], rtol=1e-12):
        raise ConfigError(f"{path} holds other pairs (another seed, or other bounds). Choose another --out.")
    return rows[: len(drawn)]
