"""`diffcloud import`: recordings of others become episodes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffcloud.io.episodes import write_episode
from diffcloud.io.imports import cloud_folder, release_episodes
from pipeline.console import JsonFlag, errors, finish

app = typer.Typer(no_args_is_help=True, help="Turn recordings of others into episodes.")


@app.command()
def release(
    folder: Annotated[Path, typer.Argument(help="Holds lift_real_pcls/, fold_real_pcls/, band_sim_pcls/, hang_sim_pcls/.")],
    out: Annotated[Path, typer.Option(help="Folder; episodes go to OUT/release_<lift|fold|band|hang>/.")],
    json: JsonFlag = False,
) -> None:
    """Import the data published with the paper."""
    written: dict[str, list[str]] = {}
    for scenario, name, episode in release_episodes(folder):
        write_episode(out / scenario / f"{name}.npz", episode)
        written.setdefault(scenario, []).append(name)
    for scenario, names in written.items():
        errors.print(f"{scenario}: {len(names)} episodes in {out / scenario}")
    finish({"out": str(out), "episodes": written}, json)


@app.command()
def clouds(
    folder: Annotated[Path, typer.Argument(help="Numbered clouds (npy, ply, xyz, pcd), one a frame, in metres.")],
    out: Annotated[Path, typer.Option(help="Episode file (.npz).")],
    gripper: Annotated[Path | None, typer.Option(help="CSV with x, y, z [m] and optionally t_s; one row a frame.")] = None,
    rate_hz: Annotated[float | None, typer.Option(help="Frame rate, if the CSV has no t_s.")] = None,
    scenario: Annotated[str | None, typer.Option(help="Name kept in the episode's metadata.")] = None,
    fabric: Annotated[str | None, typer.Option(help="Fabric kept in the episode's metadata.")] = None,
    json: JsonFlag = False,
) -> None:
    """Import a folder of clouds and a gripper track."""
    meta = {name: value for name, value in (("scenario", scenario), ("fabric", fabric)) if value is not None}
    episode = cloud_folder(folder, gripper=gripper, rate_hz=rate_hz, meta=meta)
    write_episode(out, episode)
    errors.print(f"Wrote {episode.frame_count} frames, {len(episode.points)} points to {out}.")
    finish({"out": str(out), "frames": episode.frame_count, "points": len(episode.points)}, json)
