"""`diffcloud view`: a page to look at episodes, before and after a fit."""

from __future__ import annotations

import time
import webbrowser
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from diffcloud.cli.options import JsonFlag, ParamsFile, SceneName
from diffcloud.console import (
    episode_files,
    errors,
    finish,
    progress_bar,
    refuse_many,
    told_progress,
    warn,
    writes,
)
from diffcloud.errors import ConfigError
from diffcloud.io.episodes import Episode, read_episode
from diffcloud.io.files import write_text

if TYPE_CHECKING:
    from diffcloud.estimation.record import FitRecord
    from diffcloud.reporting.overlay import Layer, Overlay
    from diffcloud.sensing.fusion import Seen

_MOST_EPISODES = 50
"""On a page, where each takes about a second and a megabyte."""
_POLL_S = 0.1
"""Between looks at the folder of a raw episode."""
_PHOTOGRAPH_PX = 900
"""Widest row of the cameras' images."""


@writes(".html")
def view(
    episodes: Annotated[
        list[Path],
        typer.Argument(help="Folders of numbered clouds, episode files (.npz), folders of them, or raw episodes."),
    ],
    out: Annotated[Path, typer.Option(help="HTML file.")] = Path("view.html"),
    scene: SceneName = None,
    fit: Annotated[Path | None, typer.Option(help="fit.json of a fit to these recordings.")] = None,
    frames: Annotated[int, typer.Option(min=1, max=1000, help="Frames shown of a recording, evenly spread.")] = 60,
    points: Annotated[int, typer.Option(min=1, max=100_000, help="Points shown of a cloud.")] = 2000,
    live: Annotated[bool, typer.Option("--live", help="Follow a raw episode while it is recorded. Ctrl-C stops.")] = False,
    calibration: Annotated[Path | None, typer.Option(help="With --live: calibration file. Default: camera.json.")] = None,
    port: Annotated[
        int, typer.Option(min=1024, max=65535, help="With --live: port. If it is in use, the next free one.")
    ] = 8080,
    open_: Annotated[bool, typer.Option("--open", help="Open the page in a browser.")] = False,
    params: ParamsFile = None,
    json: JsonFlag = False,
) -> None:
    """Show recordings on one page: clouds, gripper, cloth, table and cameras over time, and what looks wrong.

    Without --scene and --fit, the cloth is the one that `diffcloud fit` would start from.
    --scene simulates its cloth under the recorded gripper. --fit shows the fitted cloth, with and without its pose.
    Raw episodes are converted to clouds, and their images show what was masked.
    """
    from diffcloud.reporting.view import build_view

    if live:
        if len(episodes) != 1:
            raise ConfigError(f"--live follows one raw episode, got {len(episodes)} paths.")
        _follow(episodes[0], calibration, points, port, open_=open_)
        return
    record = None
    if fit is not None:
        from diffcloud.estimation.record import read_fit

        record = read_fit(fit)
    overlays, facts, problems = [], [], list[tuple[str, str]]()
    paths = [path for given in episodes for path in ([given] if _is_folder(given) else episode_files([given]))]
    refuse_many(paths, _MOST_EPISODES, "A page shows", "Give fewer episodes, or make several pages")
    for path in told_progress("drawing", [path.absolute() for path in paths]):  # "." has no name
        seen = _seen(path, params)
        chosen = _spread(seen.episode.frame_count, frames)
        layers, told, odd = _layers(path, seen.episode, chosen, points, scene, fit, record)
        overlays.append(_overlay(path.stem, seen, chosen, layers))
        facts += [(path.stem, line) for line in (_about(seen.episode), *told)]
        problems += [(path.stem, line) for line in (*seen.missing, *odd)]
    note = "Masked pixels are red, what was kept as cloth is green." if any(one.photographs for one in overlays) else ""
    title = paths[0].absolute().stem if len(paths) == 1 else f"{len(paths)} episodes"
    page = build_view(overlays, title=title, note=note, facts=facts, problems=problems)
    write_text(out, page)
    for name, text in problems:
        warn(f"{name}: {text}")
    errors.print(f"Wrote {out} ({len(page) / 1e6:.1f} MB).", soft_wrap=True)
    if open_:
        webbrowser.open(out.resolve().as_uri())
    result = {"out": str(out), "episodes": len(overlays), "bytes": len(page.encode())}
    finish({**result, "problems": [f"{name}: {text}" for name, text in problems]}, json)


def _follow(folder: Path, calibration: Path | None, points: int, port: int, *, open_: bool) -> None:
    """Show clouds, cameras and tool while an episode is recorded. It need not exist yet, or may be finished."""
    from diffcloud.io.calibrations import read_calibration
    from diffcloud.live.follower import Follower
    from diffcloud.live.page import LivePage

    known = None if calibration is None else read_calibration(calibration)
    follower = Follower(folder, known, points=points)
    with LivePage(port=port, title=folder.name) as page, suppress(KeyboardInterrupt):  # which is how this ends
        errors.print(f"Watching {folder} at {page.url} (Ctrl-C stops watching).", soft_wrap=True)
        if not folder.exists():
            errors.print(f"{folder} does not exist yet; waiting for it.", soft_wrap=True)
        if open_:
            webbrowser.open(page.url)
        while True:
            if (frame := follower.newest()) is not None:
                page.show(frame)
                if frame.status != "recording":
                    errors.print(f"Recording {frame.status}. The page keeps its last frame until Ctrl-C.")
            time.sleep(_POLL_S)


@dataclass(frozen=True)
class _Shown:
    """A recording to show."""

    episode: Episode
    photographs: Mapping[int, bytes] = field(default_factory=dict)
    """Of a raw episode, a JPEG for each frame."""
    missing: Sequence[str] = ()
    """Sentences on what the recording lacks."""


def _layers(
    path: Path,
    episode: Episode,
    frames: list[int],
    points: int,
    scene: str | None,
    fit: Path | None,
    record: FitRecord | None,
) -> tuple[list[Layer], list[str], list[str]]:
    """Return what is drawn of one episode, lines of the table, and what looks wrong."""
    from diffcloud.jobs.scenarios import choose_scenario, fitted_scenario, scene_named
    from diffcloud.jobs.view import proposed_scene
    from diffcloud.reporting.overlay import fitted_layers, recorded_layers
    from diffcloud.reporting.view import proposed_layers, scene_layers, table_layers, unposed_layer, world_axes
    from diffcloud.scene.scenarios import SCENARIO_NAMES

    times = episode.times[frames]
    meant = episode.meta.get("scenario")
    if fit is None and scene is None and meant in SCENARIO_NAMES:
        scene = str(meant)
    alone = fit is None and scene is None
    layers = recorded_layers(episode, frames, points=points, rng=np.random.default_rng(0), gripper=alone)
    layers += world_axes(episode.points)
    if fit is not None and record is not None:
        from diffcloud.estimation.result import read_motion

        place = record.place_of(path.stem, None)
        recording, motion = record.episodes[place], read_motion(fit.with_suffix(".npz"), place)
        found = scene_named(scene) if scene else choose_scenario(fitted_scenario(fit, recording.scenario))
        layers += fitted_layers(motion, times)
        layers += [unposed_layer(found, recording, motion, times), *table_layers(found, motion.nodes.reshape(-1, 3))]
        values = ", ".join(f"{key} {one.value:.3g} {one.unit}" for key, one in record.parameters.items())
        return layers, [f"fitted in {recording.scenario}: {values}; RMS {recording.rms_mm:.1f} mm"], []
    if scene is None:
        proposed, odd = proposed_scene(episode, path.stem)
        if proposed is None:
            return layers, ["no scene: the recording alone"], odd
        about = ", ".join(f"{side:.3f}" for side in np.ptp(proposed.scene.mesh.verts, axis=0))
        return layers + proposed_layers(proposed), [f"proposed cloth: sides {about} m"], odd
    chosen = scene_named(scene)
    return layers + scene_layers(chosen, episode, times), [f"scene {chosen.name}, nominal material"], []


def _overlay(name: str, seen: _Shown, frames: list[int], layers: list[Layer]) -> Overlay:
    from diffcloud.reporting.overlay import Overlay

    photographs = [seen.photographs[frame] for frame in frames] if seen.photographs else []
    return Overlay(name, frames, seen.episode.times[frames], layers, photographs=photographs)


def _about(episode: Episode) -> str:
    sizes = np.diff(episode.offsets)
    grippers = "no gripper track" if episode.gripper is None else f"grippers: {', '.join(episode.grippers)}"
    cameras = ", ".join(episode.viewpoints) or "not known"
    return (
        f"{episode.frame_count} frames over {episode.times[-1] - episode.times[0]:.2f} s, {sizes.min()} to {sizes.max()} "
        f"points a frame, {grippers}, cameras: {cameras}"
    )


def _is_folder(path: Path) -> bool:
    """Whether a folder is one recording: a raw episode or numbered clouds."""
    from diffcloud.jobs.view import is_cloud_folder

    return _is_raw(path) or is_cloud_folder(path)


def _seen(path: Path, params: Path | None) -> _Shown:
    """Read a recording of any kind."""
    from diffcloud.jobs.view import cloud_recording

    if _is_raw(path):
        return _raw(path, params)
    if not path.is_dir():
        return _Shown(read_episode(path))
    episode, missing = cloud_recording(path)
    return _Shown(episode, missing=missing)


def _is_raw(path: Path) -> bool:
    return (path / "episode.json").is_file()


def _raw(path: Path, params: Path | None) -> _Shown:
    """A raw episode as `diffcloud data preprocess` makes clouds of it."""
    from diffcloud.io.images import encode_jpeg
    from diffcloud.io.raw_episodes import read_raw_episode
    from diffcloud.jobs.preprocess import aligned, robot_mask
    from diffcloud.jobs.settings import load_config
    from diffcloud.sensing.fusion import fuse
    from diffcloud.sensing.pictures import mask_picture

    config = load_config(params).preprocess
    settings = config.raw
    raw = read_raw_episode(path)
    photographs: dict[int, bytes] = {}

    def watch(frame: int, parts: Mapping[str, Seen]) -> None:
        photographs[frame] = encode_jpeg(mask_picture(raw.cameras, parts), width=_PHOTOGRAPH_PX)

    with progress_bar(f"fusing {path.name}", len(next(iter(raw.cameras.values())).frames)) as update:
        episode = fuse(raw, robot_mask(settings), settings.fusion(), tell=update, watch=watch)
    return _Shown(aligned(episode, config, path.name, raw), photographs)


def _spread(count: int, most: int) -> list[int]:
    """At most so many frames, the first and the last among them."""
    return [int(frame) for frame in np.unique(np.linspace(0, count - 1, min(count, most)).round())]
