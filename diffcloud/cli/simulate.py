"""`diffcloud simulate`: a set of simulated runs with drawn parameters, to train the regressors on."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from diffcloud.cli.config import load_config
from diffcloud.cli.console import JsonFlag, ParamsFile, Threads, errors, finish, progress_bar, show, warn, writes
from diffcloud.cli.ctrl_c import none_lost
from diffcloud.cli.scenario_options import ScenarioName, SceneFile, choose_scenario
from diffcloud.datasets import ParameterBox, ParameterDraws, SimulationPlan, simulate_set
from diffcloud.settings import updated
from diffcloud.sim.threads import use_threads

_INTERRUPTED = 130


@writes()
def simulate(
    out: Annotated[Path, typer.Option(help="Folder of the set; an interrupted run resumes from OUT.partial.")],
    scenario: ScenarioName = None,
    scene: SceneFile = None,
    params: ParamsFile = None,
    train: Annotated[int | None, typer.Option(help="Runs to train on.")] = None,
    test: Annotated[int | None, typer.Option(help="Runs to test on.")] = None,
    draws: Annotated[str | None, typer.Option(help="uniform, sobol, logarithmic, or modes (as published).")] = None,
    parameters: Annotated[str | None, typer.Option(help="Comma-separated, e.g. stretch,mass.")] = None,
    doubts: Annotated[
        str | None,
        typer.Option(help="Vary other material from run to run, by such factors: bending=1.5x,drag=1.3x. Default: none."),
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Of the draws and of exported clouds.")] = None,
    threads: Threads = None,
    workers: Annotated[
        int, typer.Option(min=0, max=1024, help="Local processes with one thread each, instead of the threads of this one.")
    ] = 0,
    scheduler: Annotated[str | None, typer.Option(help="Address of a Dask scheduler, e.g. tcp://host:8786.")] = None,
    export_clouds: Annotated[
        bool, typer.Option("--export-clouds", help="Write every cloud too, to OUT/clouds/<split>/<run>/<frame>.npy.")
    ] = False,
    json: JsonFlag = False,
) -> None:
    """Simulate runs with drawn parameters. Ctrl-C keeps what is finished; the same call goes on from there."""
    use_threads(threads)
    settings = updated(
        load_config(params).simulate,
        parameters=None if parameters is None else [name.strip() for name in parameters.split(",")],
        draws=draws,
        doubts=doubts,
        train=train,
        test=test,
        seed=seed,
    )
    chosen = choose_scenario(scenario, scene)
    box = ParameterBox.build(settings.parameters, chosen.bounds)
    plan = SimulationPlan(
        chosen,
        ParameterDraws(box, settings.draws, chosen.name, settings.seed, settings.known_within()),
        {"train": settings.train, "test": settings.test},
    )
    with progress_bar(f"simulating {chosen.name}", settings.train + settings.test) as update:
        try:
            with none_lost():
                outcome = simulate_set(
                    plan,
                    out,
                    workers=workers,
                    scheduler=scheduler,
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
        str(settings.train),
        str(settings.test),
        settings.draws,
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
            "train": settings.train,
            "test": settings.test,
            "draws": settings.draws,
            "parameters": list(box.names),
            "resumed": outcome.resumed,
            "replaced": replaced,
            "seconds": outcome.seconds,
            "megabytes": megabytes,
        },
        json,
    )
