"""`diffcloud identify`: from recordings of a cloth to its parameters, in one command."""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
import typer
import yaml

import diffcloud
from diffcloud.cli import ctrl_c
from diffcloud.cli.config import Config
from diffcloud.cli.console import JsonFlag, Threads, Topics, duration_s, errors, finish, progress_bar, warn
from diffcloud.cli.fit_jobs import FitJob
from diffcloud.cli.preprocess import PreprocessJob
from diffcloud.cli.workers import check_interrupt
from diffcloud.errors import ConfigError, DiffCloudError, EpisodeError
from diffcloud.estimation import FitRecord, JointObjective, Objective
from diffcloud.estimation.joint import AnyObjective
from diffcloud.estimation.result import physical_values, read_motion
from diffcloud.estimation.settings import FitSettings
from diffcloud.estimation.task import Recording, compared
from diffcloud.evaluation.intervals import FOLLOWS, LEVEL, WITHIN, Intervals, intervals_of, significant
from diffcloud.evaluation.methods import space_of
from diffcloud.evaluation.summary import largest_sources
from diffcloud.identification import fit_settings, found_cloth, known_grip, with_density
from diffcloud.io.episodes import Episode, read_episode, write_episode
from diffcloud.io.files import claimed, read_json, read_yaml, together, write_bytes, write_json, write_text
from diffcloud.io.fingerprints import fingerprint
from diffcloud.io.imports import cloud_folder
from diffcloud.io.recordings import write_recording
from diffcloud.io.ros.recording import ros_recording
from diffcloud.report import EpisodeEntry, build_page
from diffcloud.scene.scenarios import Scenario, load_scenario
from diffcloud.scene.scenarios.catalogue import make_scenario, own_options
from diffcloud.scene.scenarios.layout import FIELDS, Found, find_layout
from diffcloud.sim import warm
from diffcloud.sim.properties import one_set
from diffcloud.sim.threads import use_threads

_BAGS = (".bag", ".mcap", ".db3")
_CLOTH_FIELDS = ("base", "size_m", "nodes", "material", "grip", "grip_m", "steps_per_frame")
_TRANSFERS, _GAIN = 1.25, 0.5
_Fitted = tuple[FitRecord, AnyObjective, FitJob]
"""A fit, what it minimised, and the job."""
Status = Literal["finished", "interrupted", "budget reached"]
_FITTING = 0.9
"""Part of the time of --budget after which fits end: the report needs some, too."""
_NO_TIME = "there was no time for it"
_HEAD = "# Found by diffcloud identify, with the reason beside each value. Edit and run the command again to overrule."


@dataclass
class _SoFar:
    """What is known, also when the time is over or Ctrl-C was pressed."""

    fitted: _Fitted | None = None
    intervals: Intervals | None = None
    """Of this fit; None: not yet."""


def identify(
    recordings: Annotated[
        list[Path],
        typer.Argument(
            help="Recordings of one cloth: folders of numbered clouds with a gripper.csv, raw episodes, ROS bags, episode "
            "files."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder: cloth.yaml, recordings.yaml, fit.json, report.html.")],
    size: Annotated[str | None, typer.Option(help="Sides in metres, such as 0.40x0.30. Default: as seen.")] = None,
    mass: Annotated[
        str | None, typer.Option(help="Weighed mass over area, in kg per square metre, such as 0.24 or 0.24+-0.01.")
    ] = None,
    parameters: Annotated[
        str | None,
        typer.Option(
            help="Main parameters, comma-separated; `doubts` of cloth.yaml are fitted too. Default: stretch,bending, and "
            "mass if it was not weighed."
        ),
    ] = None,
    level: Annotated[
        float | None,
        typer.Option(min=0.01, max=0.999, help="Share of intervals that should contain the truth. Default: 0.9."),
    ] = None,
    within: Annotated[
        float | None, typer.Option(help="Factor within which a parameter counts as identified. Default: 2.")
    ] = None,
    budget: Annotated[
        str,
        typer.Option(help="Time for reading, fits and report (90, 60s, 3min, 1h, none). Then the best so far is reported."),
    ] = "5min",
    topic: Topics = None,
    threads: Threads = None,
    json: JsonFlag = False,
) -> None:
    """Find the parameters of a cloth from recordings of it: layout, joint fit, intervals, and a report."""
    began = time.monotonic()
    use_threads(threads)
    level, within = level or LEVEL, WITHIN if within is None else within
    if within <= 1:
        raise ConfigError(f"--within takes a factor above 1, got {within:g}.")
    weighed = None if mass is None else _weighed(mass)
    stated = None if size is None else _sides(size)
    seconds = None if budget == "none" else duration_s(budget, "--budget")
    if out.exists() and not out.is_dir():
        raise ConfigError(f"--out takes a folder, and {out} is a file.")
    with claimed(out):
        episodes, cloth, layouts = find_scene(recordings, out, stated, None if weighed is None else weighed[0], topic or ())
        if weighed is not None and weighed[1]:
            cloth = with_density(cloth, *weighed)
        named = None if parameters is None else [name.strip() for name in parameters.split(",")]
        chosen = fit_settings(named, cloth, weighed)
        so_far = _SoFar()
        if seconds is not None:
            seconds = max(_FITTING * seconds - (time.monotonic() - began), 1.0)
            warm.implicit()  # a compilation, which is done once, is none of the time and cannot be interrupted
        status: Status = "finished"
        try:
            with ctrl_c.none_lost(), ctrl_c.pressed_after(seconds) as is_over:
                _fit(so_far, out, episodes, cloth, layouts, chosen)
                so_far.intervals = _intervals(so_far, level=level, within=within)
        except KeyboardInterrupt:
            status = "budget reached" if is_over() else "interrupted"
            if so_far.fitted is None and status == "budget reached":
                raise DiffCloudError(
                    f"--budget {budget} was over before a first loss was known. The fit of an earlier run stays. Give more "
                    "time."
                ) from None
            if so_far.fitted is None:  # Ctrl-C once more, or before a first loss beside an earlier fit
                raise
        assert so_far.fitted is not None
        record, _, job = so_far.fitted
        if so_far.intervals is None and record.estimate is not None:  # what was reached has some, too
            so_far.intervals = _intervals(so_far, level=level, within=within)
        findings = _findings(so_far, status)
        with together():
            for path in job.files:
                _copy(path, out / f"fit{path.suffix}")
            for name in episodes:
                _copy(_stage(out) / f"{name}.yaml", out / "scenarios" / f"{name}.yaml")
            write_text(out / "report.html", _page(record, so_far.intervals, findings, episodes, job))
            if so_far.intervals is not None:
                write_json(out / "intervals.json", so_far.intervals.model_dump(mode="json"))
        if so_far.intervals is None:  # those of an earlier run are of another fit
            (out / "intervals.json").unlink(missing_ok=True)
    for line in findings:
        errors.print(line, soft_wrap=True)
    errors.print(f"Wrote {out / 'report.html'}, {out / 'fit.json'}.")
    finish(_result(so_far, findings, status), json)
    if status == "interrupted":
        raise KeyboardInterrupt


def _copy(source: Path, target: Path) -> None:
    """Write nothing where nothing would change."""
    content = source.read_bytes()
    if not target.is_file() or target.read_bytes() != content:
        write_bytes(target, content)


def find_scene(
    recordings: Sequence[Path],
    out: Path,
    size: tuple[float, float] | None,
    mass: float | None,
    topics: Sequence[str] = (),
) -> tuple[dict[str, Episode], dict[str, Any], dict[str, dict[str, Any]]]:
    """Read the recordings, and find or read what cloth.yaml and recordings.yaml say of them.

    Args:
        topics: of ROS recordings, those to take where several could be (`ros_recording`).

    Returns:
        Recording -> episode, the cloth's fields of a scenario, and recording -> its own.

    Raises:
        EpisodeError: a recording that cannot be used.
        ConfigError, SceneError: one of both files says what cannot be, or topics without a ROS recording.
    """
    names = _names(recordings)
    if topics and not any(map(_is_bag, names.values())):
        raise ConfigError("--topic chooses among the topics of a ROS recording, and none was given. Leave --topic out.")
    episodes = {name: _read(path, name, out, topics) for name, path in names.items()}
    path = out / "recordings.yaml"
    with together():  # nothing of a scene that was not found would count in the next run
        cloth = _cloth(out, episodes, size, mass)
        stated = _fields(path).keys() if path.is_file() else set[str]()
        layouts = _layouts(out, episodes, names, cloth)
        _warn_of_changes(out, episodes, stated)
    return episodes, cloth, layouts


def _sides(text: str) -> tuple[float, float]:
    parts = text.lower().split("x")
    try:
        sides = tuple(float(part) for part in parts)
    except ValueError:
        sides = ()
    if len(sides) != 2 or not all(0 < side < 10 for side in sides):
        raise ConfigError(f"--size takes two sides in metres, such as 0.40x0.30, got {text!r}.")
    return sides


def _names(recordings: Sequence[Path]) -> dict[str, Path]:
    named: dict[str, Path] = {}
    for path in recordings:
        if not path.exists():
            raise ConfigError(f"No such recording: {path}.")
        name = path.stem if path.is_file() else path.absolute().name
        if name in named:
            raise ConfigError(f"Two recordings are named {name}; rename one.")
        named[name] = path
    return named


def _is_bag(path: Path) -> bool:
    return path.suffix in _BAGS or (path / "metadata.yaml").is_file()


def _read(path: Path, name: str, out: Path, topics: Sequence[str] = ()) -> Episode:
    """A recording as an episode, kept in OUT/episodes/."""
    kept = out / "episodes" / f"{name}.npz"
    if _is_bag(path):
        path = _unpacked(path, out / "recordings" / name, topics)
    if path.is_file():
        episode = read_episode(path)
    elif (path / "episode.json").is_file():
        job = PreprocessJob("episodes", path.absolute(), out, Config().preprocess, None)
        for message in job.run(lambda done, text: None).warnings:
            warn(f"{name}: {message}")
        return read_episode(kept)
    else:
        track = path / "gripper.csv"
        if not track.is_file():
            raise EpisodeError(f"{path} holds no gripper.csv with the columns t_s, x, y, z [m], one row a frame.")
        episode = cloud_folder(path, grippers={"gripper": track})
    write_episode(kept, episode)
    return episode


def _unpacked(bag: Path, folder: Path, topics: Sequence[str]) -> Path:
    """A ROS recording as a raw episode, kept in OUT/recordings/: what `import recording` makes of it by default."""
    from diffcloud.cli.importing import recording_kind, robot_description  # not above: it brings the SDK's library

    if recording_kind(bag) != "ros":
        raise EpisodeError(
            f"{bag} is a recording of the RealSense SDK, which does not say where the camera stands: make a raw episode of "
            "it first, by `diffcloud import recording NAME=FILE` and a calibration."
        )
    files = sorted(bag.rglob("*")) if bag.is_dir() else [bag]
    source: dict[str, Any] = {"files": [[one.name, one.stat().st_size, one.stat().st_mtime_ns] for one in files]}
    if topics:
        source["topics"] = sorted(topics)
    told = folder.with_name(f"{folder.name}.source.json")
    if not folder.is_dir():
        write_recording(folder, ros_recording(bag, description=partial(robot_description, None), topics=topics))
        write_json(told, source)
    elif not told.is_file() or read_json(told) != source:
        raise EpisodeError(
            f"{folder} was made of another {bag.name} than {bag} is now, or with other topics. Remove {folder} to have it "
            "made anew."
        )
    return folder


def _cloth(
    out: Path, episodes: Mapping[str, Episode], stated: tuple[float, float] | None, mass: float | None
) -> dict[str, Any]:
    """The fields of cloth.yaml: read if it is there, else found and written."""
    path = out / "cloth.yaml"
    if path.is_file():
        fields = _fields(path)
        _refuse_missing(fields, _CLOTH_FIELDS, str(path))
        own_options(fields, "cloth", path, folder=out)
        if stated is not None and list(stated) != fields["size_m"]:
            other = f"--size {stated[0]:g}x{stated[1]:g}"
            warn(f"{path} says size_m {fields['size_m']}, and that counts, not {other}: edit the file.")
        if isinstance(fields.get("material"), str) and fields["material"].endswith(".json"):
            fields["material"] = str((out / fields["material"]).resolve())  # scenarios are written to another folder
        return fields
    found = found_cloth(list(episodes.values()), stated, mass)
    write_text(path, _yaml(found))
    return {name: entry.value for name, entry in found.items()}


def _layouts(
    out: Path, episodes: Mapping[str, Episode], sources: Mapping[str, Path], cloth: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """The fields of each recording in recordings.yaml: read where they are there, else found and written."""
    path = out / "recordings.yaml"
    known = _fields(path) if path.is_file() else {}
    size = (float(cloth["size_m"][0]), float(cloth["size_m"][1]))
    blocks, layouts = [path.read_text().rstrip()] if known else [_HEAD], {}
    for name, episode in episodes.items():
        if name in known:
            if not isinstance(known[name], dict):
                raise ConfigError(f"{path}: {name} must be a mapping of a scenario's fields, got {known[name]!r:.60}.")
            layouts[name] = dict(known[name])
            _refuse_missing(layouts[name], FIELDS, f"{path}: {name}")
            where = f"{out / 'cloth.yaml'} with {name} of {path}"
            options = own_options({**cloth, **layouts[name]}, name, where, folder=out)
            try:
                make_scenario(options)
            except DiffCloudError as error:
                raise ConfigError(f"{where}: {error}") from error
            continue
        try:
            layout = find_layout(episode, size, 0.0 if cloth["grip"] == "pivot" else cloth["grip_m"])
        except EpisodeError as error:
            raise EpisodeError(f"{sources[name]}: {error}") from error
        for message in layout.warnings:
            warn(f"{name}: {message}.")
        layouts[name] = {key: entry.value for key, entry in layout.fields.items()}
        lines = _yaml(layout.fields, head=False).splitlines()
        blocks.append("\n".join([f"{_inline(name)}:", *(f"  {line}" for line in lines)]))
    write_text(path, "\n".join(blocks) + "\n")
    return layouts


def _warn_of_changes(out: Path, episodes: Mapping[str, Episode], stated: Collection[str]) -> None:
    """Say which recordings are not those any more that their blocks in recordings.yaml were made for, which count.

    Args:
        stated: those whose blocks were there before.
    """
    path = out / "stages" / "recordings.json"
    told = read_json(path) if path.is_file() else {}
    known = {name: mark for name, mark in told.items() if name in stated} if isinstance(told, dict) else {}
    for name, one in episodes.items():
        mark = fingerprint([one.points, one.times, one.gripper], packages=())
        if known.setdefault(name, mark) != mark:
            warn(
                f"{name} is another recording than that which its block in {out / 'recordings.yaml'} was made for, and the "
                "block counts. Remove it to have the layout found anew."
            )
    write_json(path, known)


def _refuse_missing(fields: Mapping[str, Any], needed: Sequence[str], where: str) -> None:
    """A built-in's own value would stand in for what is missing, and nobody would know."""
    missing = [name for name in needed if name not in fields]
    if missing:
        raise ConfigError(f"{where} lacks {', '.join(missing)}. Put it back, or remove the whole to have it found anew.")


def _fields(path: Path) -> dict[str, Any]:
    told = read_yaml(path, error=ConfigError)
    if not isinstance(told, dict):
        raise ConfigError(f"{path} must be a mapping, got {type(told).__name__}. Remove it to have it written anew.")
    return told


def _yaml(found: Mapping[str, Found], *, head: bool = True) -> str:
    lines = [_HEAD] if head else []
    lines += [f"{name}: {_inline(entry.value)}  # {entry.reason}" for name, entry in found.items()]
    return "\n".join(lines) + "\n"


def _inline(value: Any) -> str:
    """As YAML in one line; a text that would be read as something else, such as the name 001, in quotes."""
    text: str = yaml.safe_dump(value, default_flow_style=True, width=1000, sort_keys=False)
    return text.strip().removesuffix("...").strip()


def _weighed(text: str) -> tuple[float, float]:
    """Mass and its standard deviation [kg/m²], of 0.24 or 0.24+-0.01."""
    value, _, error = text.replace("±", "+-").partition("+-")
    try:
        mass, deviation = float(value), float(error or 0.0)
    except ValueError:
        mass = deviation = math.nan
    if not (0 < mass < math.inf and 0 <= deviation < mass / 2):
        raise ConfigError(
            f"--mass is in kg per square metre, above 0, and may have a standard deviation below half of it, as in "
            f"0.24+-0.01; got {text!r}."
        )
    return mass, deviation


def _stage(out: Path) -> Path:
    """The folder of the scenarios of an unfinished fit."""
    return out / "stages" / "scenarios"


def _scenarios(out: Path, cloth: Mapping[str, Any], layouts: Mapping[str, Mapping[str, Any]]) -> dict[str, Scenario]:
    """One per recording, each written to the folder of its stage: other commands read those of the finished fit."""
    found = {}
    for name, fields in layouts.items():
        path = _stage(out) / f"{name}.yaml"
        write_text(path, yaml.safe_dump({**cloth, **fields}, sort_keys=False))
        found[name] = load_scenario(path)
    return found


def _fit(
    so_far: _SoFar,
    out: Path,
    episodes: Mapping[str, Episode],
    cloth: Mapping[str, Any],
    layouts: Mapping[str, Mapping[str, Any]],
    settings: FitSettings,
) -> None:
    """
    Args:
        so_far: takes the fit, also one that Ctrl-C has ended.
    """
    scenarios = _scenarios(out, cloth, layouts)
    members = [Recording(scenarios[name], name, episode) for name, episode in episodes.items()]
    job = FitJob("fit", members, settings, out / "stages")
    try:
        with progress_bar("identify", None) as update:
            record = job.run(update)
    except KeyboardInterrupt:
        ended = job.known()
        if ended is None and not (out / "fit.json").exists():
            ended = job.begun()  # an earlier run's fit is worth more than the place where this one begins
        if ended is not None:
            so_far.fitted = ended, compared(ended, _with_grip_found(members, ended, out)), job
        raise
    check_interrupt()
    so_far.fitted = record, compared(record, _with_grip_found(members, record, out)), job


def _with_grip_found(members: Sequence[Recording], record: FitRecord, out: Path) -> list[Recording]:
    """The recordings in scenarios with the grasp that was found; their files have it too."""
    found = None if record.estimate is None else record.estimate.grip_m
    if found is None:
        return list(members)
    told = []
    for one in members:
        path = _stage(out) / f"{one.name}.yaml"
        write_text(path, yaml.safe_dump({**_fields(path), **known_grip(found)}, sort_keys=False))
        told.append(replace(one, scenario=load_scenario(path)))
    return told


def _intervals(so_far: _SoFar, *, level: float, within: float) -> Intervals:
    assert so_far.fitted is not None
    record, objective, _ = so_far.fitted
    return intervals_of(record, space_of(record), objective.members[0].scenario, level=level, within=within)


def _validation(record: FitRecord, objective: AnyObjective) -> str:
    """Whether parameters fitted without a given recording still explain it."""
    if not isinstance(objective, JointObjective):
        return "One recording: whether its parameters carry over to another is not known."
    held, gains = [], []
    weighed = space_of(record).fixed
    for member, episode in zip(objective.members, record.episodes, strict=True):
        if episode.left_out is None and record.stop_reason == "interrupted":
            return f"Whether parameters carry over from one recording to another is not known: {_NO_TIME}."
        if episode.left_out is None:
            return "Leaving one recording out failed: whether parameters carry over is not known."
        with torch.no_grad():
            run = member.simulate_to_loss(one_set({**weighed, **record.laid_in(episode)}))
            middle = float(member.frame_losses(run).mean())  # as the others, without the prior of the pose
        held.append(episode.left_out.rms_mm / episode.rms_mm)
        gains.append((middle - episode.left_out.loss) / max(middle - episode.loss, 1e-300))
    told = f"when a recording is left out of the fit, its misfit is at most {max(held):.2f} times that in the joint fit"
    motions = len({_motion_of(member) for member in objective.members})
    if max(held) <= _TRANSFERS and min(gains) >= _GAIN:
        return f"Transfers{'' if motions > 1 else ' within this motion'}: {told}."
    return f"Explains its own recordings only: {told}."


def _motion_of(objective: Objective) -> str:
    """What a motion is told by: its last displacement, in whole parts of the largest component."""
    track = objective.track
    if track is None:
        return "scene"
    end = track[0, -1].flatten().numpy()
    return str(np.round(end / max(float(np.abs(end).max()), 1e-9), 0).tolist())


def follows(record: FitRecord) -> list[str]:
    """Of each recording, until when the model follows it, for people."""
    lines = []
    for one, told in zip(record.episodes, record.estimate.recordings if record.estimate else (), strict=False):
        gone = np.flatnonzero(np.array(told.misfits) > FOLLOWS)
        rate = told.horizon_s / max(one.frames[-1], 1)
        if len(gone) == 0:
            told_so = f"follows {one.name} to within noise and mesh up to {told.horizon_s:.1f} s, where frames end to count"
        elif gone[0] == 0:
            told_so = f"does not follow {one.name} from the first frame on"
        else:
            told_so = f"follows {one.name} to within noise and mesh until {rate * one.frames[gone[0]]:.1f} s, then departs"
        lines.append(f"The model {told_so}.")
    return lines


def _findings(so_far: _SoFar, status: Status) -> list[str]:
    """The report's first lines: does the model explain the recordings, do parameters carry over, what are they."""
    assert so_far.fitted is not None
    record, objective, _ = so_far.fitted
    found, lines = so_far.intervals, list[str]()
    if status != "finished":
        why, again = (
            ("Ctrl-C was pressed", "")
            if status == "interrupted"
            else ("the time of --budget was over", " with --budget none")
        )
        lines.append(f"Unfinished: {why}. These are the best parameters so far. Run the same command{again} to finish.")
    if found is None:
        lines.append(
            f"The misfit is {record.rms_mm:.1f} mm RMS. It is not known whether the model explains the recordings, and "
            f"there are no intervals: {_NO_TIME}."
        )
    elif not found.explains:
        lines.append(f"The model does not explain the recordings: {found.reason}.")
    lines += follows(record)
    lines.append(_validation(record, objective))
    if found is not None and found.explains:
        lines += found.sentences
    for name, told in _parameters(so_far).items():
        digits = significant(told["low"], told["high"])
        ends, verdict, improve = "", "unfinished", ""
        if found is not None:
            entry, verdict = found.parameters[name], told["verdict"]
            first = largest_sources(found.sources, name, 2)
            ends = f", {found.level:.0%} interval {digits(entry.physical_low)} to {digits(entry.physical_high)}"
            improve = f" (improve first: {first})" if first else ""
        lines.append(f"{name}: {digits(told['physical'])} {told['physical_unit']}{ends}: {verdict}{improve}.")
    if record.estimate is not None and record.estimate.grip_m is not None:
        lines.append(f"The grasp is {1e3 * record.estimate.grip_m:.0f} mm wide, as the fit found it.")
    return lines


def _parameters(so_far: _SoFar) -> dict[str, dict[str, Any]]:
    """Of each parameter its value and, if there are intervals, these."""
    assert so_far.fitted is not None
    record, objective, _ = so_far.fitted
    if so_far.intervals is not None:
        return {
            name: {
                "value": entry.value,
                "physical": entry.physical,
                "physical_unit": entry.physical_unit,
                "low": entry.physical_low,
                "high": entry.physical_high,
                "verdict": entry.verdict,
            }
            for name, entry in so_far.intervals.parameters.items()
        }
    values = {name: record.free[name] for name in space_of(record).asked.names}
    nothing = {"low": None, "high": None, "verdict": None}
    return {
        name: {
            "value": one.value,
            "physical": one.physical,
            "physical_unit": one.physical_unit,
            **nothing,
        }
        for name, one in physical_values(objective.members[0].scenario, values).items()
    }


def _result(so_far: _SoFar, findings: Sequence[str], status: Status) -> dict[str, Any]:
    assert so_far.fitted is not None
    record, found = so_far.fitted[0], so_far.intervals
    return {
        "status": status,
        "parameters": _parameters(so_far),
        "rms_mm": record.rms_mm,
        "explains": None if found is None else found.explains,
        "reason": "" if found is None else found.reason,
        "remark": "" if found is None else found.remark,
        "horizons_s": {
            one.name: told.horizon_s
            for one, told in zip(record.episodes, record.estimate.recordings if record.estimate else (), strict=False)
        },
        "findings": list(findings),
        "episodes": {one.name: one.rms_mm for one in record.episodes},
    }


def _page(
    record: FitRecord, found: Intervals | None, findings: Sequence[str], episodes: Mapping[str, Episode], job: FitJob
) -> str:
    entries = []
    for index, recording in enumerate(record.episodes):
        row = {
            "rms_start_mm": 1e3 * record.length_unit_m * record.loss_start**0.5,
            "rms_mm": recording.rms_mm,
            "rms_other_frames_mm": math.nan,
        }
        entries.append(
            EpisodeEntry(
                scenario=recording.scenario,
                name=recording.name,
                row=row,
                fit=_with_one(record, index),
                recording=recording,
                episode=episodes[recording.name],
                motion=read_motion(job.files[1], index),
            )
        )
    return build_page(
        entries,
        title="A cloth from its recordings",
        overlay_points=1200,
        environment={"command": "diffcloud identify", "diffcloud": diffcloud.__version__},
        findings=findings,
        intervals=found,
    )


def _with_one(record: FitRecord, index: int) -> FitRecord:
    """The record with one of its recordings alone, as a page's row shows it."""
    return record.model_copy(update={"episodes": [record.episodes[index]]})
