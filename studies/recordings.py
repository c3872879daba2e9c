"""`python -m studies recordings`: synthetic raw recordings against their truth, as clouds and through a fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from diffcloud.cli.options import JsonFlag, ParamsFile, Workers
from diffcloud.console import finish, output, progress_bar, writes
from diffcloud.errors import ConfigError, DiffCloudError
from diffcloud.estimation.objective import Objective
from diffcloud.estimation.parameters import FitSpace
from diffcloud.estimation.pose import parse_priors
from diffcloud.estimation.settings import FitSettings
from diffcloud.estimation.solvers import solve
from diffcloud.evaluation.markdown import markdown_table, result_page
from diffcloud.io.episodes import Episode, read_episode
from diffcloud.io.files import folders_in, write_text
from diffcloud.io.raw_episodes import RawEpisode, read_raw_episode
from diffcloud.jobs.pool import run_all
from diffcloud.jobs.scenarios import choose_scenario
from diffcloud.jobs.settings import SynthesizeConfig, load_config
from diffcloud.scene.scenarios import Scenario
from diffcloud.sensing.recorder import Truth, read_truth
from studies.cloud_quality import CloudFigures, evaluate_clouds, visible_clouds
from studies.recorded_poses import PoseJob, pose_page, pose_rows


@writes(".md")
def recordings(
    recorded: Annotated[
        Path, typer.Option(help="Folder with raw <scenario>/<episode>/ of `python -m pipeline.synthesize`.")
    ],
    episodes: Annotated[Path, typer.Option(help="Folder with <scenario>/<episode>.npz of `diffcloud data preprocess`.")],
    out: Annotated[Path, typer.Option(help="Markdown file.")],
    fits: Annotated[bool, typer.Option(help="Also fit each: raw clouds, noise-free clouds, one camera.")] = True,
    nuisance: Annotated[
        list[str] | None,
        typer.Option(help="Instead, fit with this nuisance, and compare the pose found with the true one; repeatable."),
    ] = None,
    workers: Workers = None,
    params: ParamsFile = None,
    json: JsonFlag = False,
) -> None:
    """Measure masks, clouds and fits of synthetic raw recordings against what was recorded; writes Markdown tables."""
    config = load_config(params)
    found = [
        (name, path)
        for name in config.scenes
        for path in folders_in(recorded / name)
        if (path / "episode.json").is_file() and (path / "truth").is_dir()
    ]
    if not found:
        raise ConfigError(f"{recorded} holds no synthetic raw episodes of {', '.join(config.scenes)}.")
    if nuisance:
        for one in nuisance:
            parse_priors(one)  # refused before anything is fitted
        jobs = [
            PoseJob(choose_scenario(name), folder, episodes / name / f"{folder.name}.npz", tuple(nuisance), config.fit)
            for name, folder in found
        ]
        _poses(jobs, workers, out, config.synthesize, json)
        return
    measured: list[tuple[str, CloudFigures, Mapping[str, Any]]] = []
    fitted: list[_Fits] = []
    with progress_bar("recordings", len(found)) as update:
        for index, (name, folder) in enumerate(found):
            update(index, folder.name)
            raw, truth = read_raw_episode(folder), read_truth(folder)
            episode = read_episode(episodes / name / f"{folder.name}.npz")
            measured.append((folder.name, evaluate_clouds(episode, raw, truth), episode.meta["quality"]))
            if fits:
                fitted.append(_fit_all(choose_scenario(name), folder.name, episode, raw, truth, config.fit))
                write_text(out, _page(measured, fitted, config.fit))  # what is done is kept
    page = _page(measured, fitted, config.fit)
    write_text(out, page)
    if not json:
        output.print(page)
    finish({"out": str(out), "episodes": len(measured), **_summary(measured, fitted)}, json)


def _poses(jobs: list[PoseJob], workers: int | None, out: Path, recorded: SynthesizeConfig, json: bool) -> None:
    done, failures = [], []
    for job, told, error in run_all("recordings", jobs, workers):
        if error is None:
            done.append(told)
        else:
            failures.append(f"{job.label}: {error}")
    if done:
        page = pose_page(pose_rows(done), [fits[0] for fits in done], recorded)
        write_text(out, page)
        if not json:
            output.print(page)
    finish({"out": str(out), "recordings": done}, json)
    if failures:
        raise DiffCloudError(
            f"{len(failures)} of {len(jobs)} recordings failed and are not on the page. {'; '.join(failures)}"
        )


@dataclass(frozen=True)
class _Fits:
    """Ratios of stretching to density that fits found."""

    episode: str
    true: float
    raw: float
    noise_free: float
    overhead: float


def _fit_all(scenario: Scenario, name: str, episode: Episode, raw: RawEpisode, truth: Truth, config: FitSettings) -> _Fits:
    hidden = episode.meta["truth"]
    held = raw.placement.to_scene(truth.nodes[:, scenario.grasped].mean(axis=1))[:, None]
    clouds = [raw.placement.to_scene(cloud) for cloud in visible_clouds(raw, truth)]
    seen_from = {"viewpoints": episode.meta["viewpoints"]}
    noise_free = Episode.from_frames(clouds, episode.times, gripper=held, meta=seen_from)
    ratios = [
        _ratio(scenario, cloud, hidden["density"], config) for cloud in (episode, noise_free, _of_first_camera(episode))
    ]
    return _Fits(name, hidden["stretching"] / hidden["density"], *ratios)


def _ratio(scenario: Scenario, episode: Episode, mass: float, config: FitSettings) -> float:
    """Fitted stretching over the weighed density. With both free, bending and air hardly tell them apart
    (docs/concepts.md)."""
    objective = Objective(scenario, episode, **config.measure())
    space = FitSpace.build(["stretching"], bounds=scenario.search_range(config.bounds), fixed={"density": mass})
    return solve(objective, space, config.solver_settings(scenario)).uninterrupted().values["stretching"] / mass


def _of_first_camera(episode: Episode) -> Episode:
    assert episode.camera is not None  # clouds of raw episodes say so
    assert episode.lost is not None
    frames = [
        episode.frame(index)[episode.camera[episode.offsets[index] : episode.offsets[index + 1]] == 0]
        for index in range(episode.frame_count)
    ]
    first = episode.meta["cameras"][0]
    seen_from = {key: {first: episode.meta[key][first]} for key in ("viewpoints", "pinholes")}
    alone = Episode.from_frames(frames, episode.times, gripper=episode.gripper, meta=seen_from)
    return replace(alone, lost=np.packbits(episode.lost_pixels(0).reshape(len(frames), 1, -1), axis=-1))


def _page(measured: list[tuple[str, CloudFigures, Mapping[str, Any]]], fitted: list[_Fits], config: FitSettings) -> str:
    head = ["episode", "points", "robot %", "table %", "lost %", "lost flat %", "cloud to cloth mm", "cloth to cloud mm"]
    head += ["camera moved mm", "arm thicker mm", "log late ms"]
    rows = []
    for name, figures, quality in measured:
        part, refined = _parts(figures), quality.get("refinement")
        row = [
            name,
            f"{figures.points.min()}–{figures.points.max()}",
            _percent(part["robot"], 2),
            _percent(part["table"], 2),
        ]
        row += [_percent(part["lost"], 1), _percent(part["lost_flat"], 1), _millimetres(figures.cloud_to_cloth_m)]
        row += [_millimetres(figures.cloth_to_cloud_m)]
        if refined is not None:
            row += [", ".join(f"{1e3 * v:.1f}" for v in list(refined["shift_m"].values())[1:])]
            row += [f"{1e3 * refined['skin_m']:.1f}", f"{1e3 * refined['clock_offset_s']:.0f}"]
        rows.append(row + ["–"] * (len(head) - len(row)))
    clouds = markdown_table(head, rows)
    about = (
        "Robot and table are parts of the points of the merged clouds. Lost is the part of the visible cloth's "
        "measurements that is not in the cloud, over frames in which the cloth moves, and in which it lies flat. "
        "Distances are RMS over a frame: mean and greatest over the frames."
    )
    off = max(1e3 * float(figures.cloud_to_cloth_m.mean()) for _, figures, _ in measured)
    answer = f"Clouds lie within {off:.1f} mm of the cloth (RMS, mean over the frames)."
    if fitted:
        raw, overhead = (max(abs(_error(getattr(fit, kind), fit)) for fit in fitted) for kind in ("raw", "overhead"))
        answer += f" Stretching over density is within {100 * raw:.0f} % of the truth, with one camera within "
        answer += f"{100 * overhead:.0f} %."
    return result_page(
        "How accurate are clouds and fits of raw recordings?",
        answer,
        markdown_table(
            ["episode", "true", "noise-free", "raw", "raw, overhead only"],
            [
                [fit.episode, f"{fit.true:.3f}", *(_off(ratio, fit) for ratio in (fit.noise_free, fit.raw, fit.overhead))]
                for fit in fitted
            ],
        )
        or clouds,
        note=f"Synthetic raw recordings are preprocessed and fitted by `{config.solver}`, and compared with the truth. The "
        "density of the cloth is known. A noise-free cloud is what both cameras see of the cloth, without noise, holes or "
        f"masks. {' '.join(f'{text}.' for text in _counts(fitted))}"
        if fitted
        else about,
        command="make recordings",
        details={"Clouds": [about, clouds]} if fitted else None,
    )


def _parts(figures: CloudFigures) -> dict[str, float | None]:
    """None where no frame is of the kind that it is about."""
    points, flat = figures.points.sum(), figures.flat
    return {
        "robot": float(figures.robot.sum() / points),
        "table": float(figures.table.sum() / points),
        "lost": float(figures.lost[~flat].mean()) if (~flat).any() else None,
        "lost_flat": float(figures.lost[flat].mean()) if flat.any() else None,
    }


def _percent(part: float | None, digits: int) -> str:
    return "–" if part is None else f"{100 * part:.{digits}f}"


def _millimetres(values: Any) -> str:
    return f"{1e3 * values.mean():.1f}, {1e3 * values.max():.1f}"


def _error(ratio: float, fit: _Fits) -> float:
    return ratio / fit.true - 1


def _off(ratio: float, fit: _Fits) -> str:
    return f"{ratio:.3f} ({100 * _error(ratio, fit):+.0f} %)"


def _counts(fitted: list[_Fits]) -> list[str]:
    known = [fit for fit in fitted if abs(_error(fit.noise_free, fit)) <= 0.1]
    return [
        f"Noise-free within 10 %: {len(known)} of {len(fitted)}",
        f"Of these, raw within 20 %: {sum(abs(_error(fit.raw, fit)) <= 0.2 for fit in known)} of {len(known)}",
        "Of these, raw of the overhead camera alone within 20 %: "
        f"{sum(abs(_error(fit.overhead, fit)) <= 0.2 for fit in known)} of {len(known)}",
    ]


def _summary(measured: list[tuple[str, CloudFigures, Mapping[str, Any]]], fitted: list[_Fits]) -> dict[str, Any]:
    figures = {name: _parts(found) for name, found, _ in measured}
    return {"clouds": figures, "fits": _counts(fitted) if fitted else []}
