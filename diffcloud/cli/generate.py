"""`diffcloud network generate`: a set of simulated runs with random parameters, to train the regressors on."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any

import typer

from diffcloud.cli.options import JsonFlag, ParamsFile, SceneName, Scheduler, merged, settings_options
from diffcloud.console import errors, finish, progress_bar, show, warn, writes
from diffcloud.jobs.network_settings import GenerateSettings

_INTERRUPTED = 130


@writes()
@settings_options(
    GenerateSettings, everyday=("train", "test", "distribution", "parameters", "uncertain", "seed"), advanced=()
)
def generate(
    out: Annotated[Path, typer.Option(help="Folder of the set; an interrupted run resumes from OUT.partial.")],
    settings: Mapping[str, Any],
    scene: SceneName = None,
    workers: Annotated[int, typer.Option(min=0, max=1024, help="Processes with one thread each. 0: this one alone.")] = 0,
    scheduler: Scheduler = None,
    export_clouds: Annotated[
        bool, typer.Option("--export-clouds", help="Write every cloud too, to OUT/clouds/<split>/<run>/<frame>.npy.")
    ] = False,
    params: ParamsFile = None,
    json: JsonFlag = False,
) -> None:
    """Simulate runs with random parameters. Ctrl-C keeps what is finished; the same call goes on from there."""
    from rich.table import Table

    from diffcloud.datasets import ParameterBox, ParameterDraws, SimulationPlan, simulate_set
    from diffcloud.errors import ConfigError
    from diffcloud.jobs.cluster import scheduler_client
    from diffcloud.jobs.ctrl_c import none_lost
    from diffcloud.jobs.scenarios import scene_named
    from diffcloud.jobs.settings import load_config
    from diffcloud.scene.scenarios.uncertain import parse_uncertain

    if scene is None:
        raise ConfigError("A set needs a scene: give --scene, such as lift.")
    stated = merged(load_config(params).generate, settings)
    chosen = scene_named(scene)
    box = ParameterBox.build(stated.parameters, chosen.bounds)
    plan = SimulationPlan(
        chosen,
        ParameterDraws(box, stated.distribution, chosen.name, stated.seed, parse_uncertain(stated.uncertain or "none")),
        {"train": stated.train, "test": stated.test},
    )
    with progress_bar(f"simulating {chosen.name}", stated.train + stated.test) as update:
        try:
            with none_lost(), nullcontext() if scheduler is None else scheduler_client(scheduler) as client:
                outcome = simulate_set(
                    plan,
                    out,
                    workers=workers,
                    client=client,
                    clouds=chosen.points if export_clouds else None,
                    progress=lambda done: update(done, ""),
                )
        except KeyboardInterrupt:
            errors.print(f"Interrupted: finished runs are kept in {out}.partial; the same command goes on from there.")
            raise typer.Exit(_INTERRUPTED) from None
    if outcome.discarded:
        warn(f"{out}.partial belonged to other settings or other code; it was started again.")
    megabytes = sum(file.stat().st_size for file in out.rglob("*") if file.is_file()) / 1e6
    replaced = {split: len(entries) for split, entries in outcome.replaced.items()}
    for split, count in replaced.items():
        if count:
            warn(f"{count} draws of {split} diverged and were replaced; {out / 'replaced.csv'} says which and why.")
    table = Table("scenario", "train", "test", "draws", "parameters", "taken up", "seconds", "MB")
    table.add_row(
        chosen.name,
        str(stated.train),
        str(stated.test),
        stated.distribution,
        ", ".join(box.names),
        str(outcome.resumed),
        f"{outcome.seconds:.1f}",
        f"{megabytes:.1f}",
    )
    show(table, json)
    finish(
        {
            "out": str(out),
            "scenario": chosen.name,
            "train": stated.train,
            "test": stated.test,
            "draws": stated.distribution,
            "parameters": list(box.names),
            "resumed": outcome.resumed,
            "replaced": replaced,
            "seconds": outcome.seconds,
            "megabytes": megabytes,
        },
        json,
    )
