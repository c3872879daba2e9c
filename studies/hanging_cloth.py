"""Does air move with a cloth? Fourteen recordings of a real one that hangs from a bar, swings with it, and swings freely.

    python -m studies hanging FOLDER

Added mass and drag are fitted to three recordings and predict the others, for which only the pose is fitted. FOLDER holds
NPZ files, in the robot's frame, z up [m, s]: `cloud_times` [F] when a cloud was published, `clouds` [F, 64, 3] eight rows
from the bar down, NaN where there was no depth, `tool_times` [K], `tool_positions` [K, 3], `tool_quaternions_xyzw` [K, 4].
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from diffcloud.clouds.surface import NO_GUESS, find_on_surface
from diffcloud.errors import DiffCloudError, EpisodeError
from diffcloud.evaluation.markdown import markdown_table, result_page
from diffcloud.io.arrays import read_npz
from diffcloud.io.episodes import Episode
from diffcloud.io.files import write_bytes, write_text
from diffcloud.io.stamps import stamp_lags
from diffcloud.mesh import grid_cloth
from diffcloud.sim import Properties, Rollout, System, rollout, rollout_tangents, scaled_properties
from diffcloud.sim.build import build_system
from diffcloud.sim.handles import Handle, Handles
from diffcloud.sim.materials import isotropic
from diffcloud.sim.motion import Keyframe, Motion
from diffcloud.sim.surrounding import Surrounding

Floats = NDArray[np.float64]

FITTED = ("range30_rep1", "range60_rep1", "range90_rep1")
"""The first recording of each of three ranges; the others are predicted."""
PAGE = Path("docs/results/hanging-cloth.md")
_ARRAYS = {"cloud_times": 1, "clouds": 3, "tool_times": 1, "tool_positions": 2, "tool_quaternions_xyzw": 2}
_MOST = 10_000
"""Clouds and positions of a file."""
_SIDE, _BAR = 0.30, 0.085
"""[m] Of the cloth, and from the tool down to the bar."""
_ROWS, _NODES, _STEP = 8, 7, 0.02
"""Of a cloud; nodes a side; [s]"""
_DENSITY = 0.2
"""[kg/m²] Assumed: the motion depends on the ratios of added mass and drag to it."""
_MOVES = 0.03
"""[m/s] A slower bar stands still."""
_LATE = 0.01
"""[s] Standard deviation of the lag that all frames share."""
_STRETCHING, _BENDING, _DAMPING = 60.0, 1e-5, 0.02
"""[N/m], [N·m], [s] Usual of woven cloth; the motion hardly depends on them."""
_NOISE = 0.012
"""[m] What is left of a fit, against which the prior of the lag counts."""
_START = {"added_mass": 0.5, "linear_drag": 0.5, "air_density": 0.7}


@dataclass(frozen=True)
class Recording:
    """One recording, with the times at which its clouds were taken."""

    name: str
    times: Floats
    """[F] [s]"""
    points: Floats
    """[F, 64, 3] [m]; what is not `seen` repeats a point that is."""
    seen: NDArray[np.bool_]
    """[F, 64]"""
    start: Floats
    """[7, 3] where the held nodes start [m]."""
    track: Floats
    """[S, 7, 3] their displacement at the end of each step [m]."""
    stop: float
    """[s] When the bar stands still again."""


def read_recording(path: Path) -> Recording:
    """A recording, re-timed, from the bar's first motion on.

    Raises:
        EpisodeError: unreadable, arrays of other shapes, or a bar that does not move.
    """
    raw = read_npz(path, kind="recording of a hanging cloth", error=EpisodeError, names=_ARRAYS)
    shapes = {name: array.shape for name, array in raw.items()}
    frames, moments = len(raw["cloud_times"]), len(raw["tool_times"])
    wanted = dict(zip(_ARRAYS, [(frames,), (frames, _ROWS**2, 3), (moments,), (moments, 3), (moments, 4)], strict=True))
    if shapes != wanted or not (min(frames, moments) >= 2 and max(frames, moments) <= _MOST):
        raise EpisodeError(
            f"{path} has the shapes {shapes}; a recording of 2 to {_MOST} clouds and positions has {wanted}."
        )
    published, clouds, times, tool, turns = (raw[name].astype(np.float64) for name in _ARRAYS)
    known = [published, times, tool, turns]
    if not all(np.isfinite(one).all() for one in known) or (np.diff(times) < 0).any() or (np.diff(published) <= 0).any():
        raise EpisodeError(f"{path} has times that do not increase, or positions that are no numbers. Export it again.")
    if not np.linalg.norm(turns, axis=1).min() > 0.5:
        raise EpisodeError(f"{path} has quaternions of length zero; they have length one. Export it again.")
    times, first = np.unique(times, return_index=True)
    turn = Rotation.from_quat(turns[first])
    offsets = np.array([0, 0, -_BAR]) + np.linspace(-_SIDE / 2, _SIDE / 2, _NODES)[:, None] * [1.0, 0, 0]
    held = tool[first, None] + np.einsum("kij,nj->kni", (turn * turn[0].inv()).as_matrix(), offsets)
    moving = _moving(times, held.mean(1))
    seen: NDArray[np.bool_] = np.asarray(np.isfinite(clouds).all(-1))
    usable = seen.sum(1) > _ROWS
    if usable.sum() < 2:
        raise EpisodeError(f"{path} has {usable.sum()} clouds with more than {_ROWS} points; two or more are needed.")
    stamps = published[usable]
    episode = Episode.from_frames(
        [cloud[one] for cloud, one in zip(clouds[usable], seen[usable], strict=True)],
        stamps - stamps[0],
        gripper=_at(stamps, times, held.mean(1))[:, None],
    )
    lags = stamp_lags(episode)
    if lags is None:
        raise EpisodeError(f"The bar of {path} moves too little to tell when its clouds were taken.")
    taken = stamps - lags.seconds
    clouds, seen = clouds[usable], seen[usable]
    steps: Floats = _STEP * np.arange(1.0, int(times[-1] / _STEP) + 1)
    used = (taken > moving[0]) & (taken < steps[-1])
    if not used.any():
        raise EpisodeError(f"{path} has no cloud while the bar or the cloth moves; it needs some.")
    whole = np.where(seen[..., None], clouds, np.take_along_axis(clouds, seen.argmax(1)[:, None, None], 1))
    return Recording(
        path.stem,
        taken[used],
        np.ascontiguousarray(whole[used]),
        seen[used],
        held[0],
        _at(steps, times, held) - held[0],
        moving[1],
    )


def _means(points: Floats, seen: NDArray[np.bool_]) -> Floats:
    """[F, 3] of the points [F, N, 3] that are seen; NaN where none is."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(seen[..., None], points, 0.0).sum(1) / seen.sum(1)[:, None])


def swing(times: Floats, values: Floats) -> tuple[float, float]:
    """Period [s] and decay [1/s] of a damped oscillation about a constant, by least squares.

    Args:
        times, values: [N] at least six of them, over a period or so; periods of 0.6 to 1.6 s are looked for.
    """
    times = times - times[0]

    def apart(guess: Floats) -> Floats:
        wave = np.exp((1j * guess[0] - guess[1]) * times)
        basis = np.stack([np.ones_like(times), wave.real, wave.imag], 1)
        return np.asarray(basis @ np.linalg.lstsq(basis, values, rcond=None)[0] - values)

    low, high = 2 * np.pi / 1.6, 2 * np.pi / 0.6
    tries = [
        least_squares(apart, [2 * np.pi / period, 0.5], bounds=([low, 0], [high, 5])) for period in (0.8, 0.95, 1.1, 1.3)
    ]
    best = min(tries, key=lambda one: float(one.cost)).x
    return float(2 * np.pi / best[0]), float(best[1])


def _at(moments: Floats, times: Floats, values: Floats) -> Floats:
    """[..., ...] values [K, ...] at moments [...], linear between the times [K]."""
    place = np.interp(moments, times, np.arange(len(times)))
    low = np.minimum(place.astype(int), len(times) - 2)
    share = (place - low).reshape(*place.shape, *[1] * (values.ndim - 1))
    return np.asarray(values[low] * (1 - share) + values[low + 1] * share)


def _moving(times: Floats, bar: Floats) -> tuple[float, float]:
    """[s] When the bar [K, 3] begins to move, and when it stands still for good."""
    even = np.arange(times[0], times[-1], 0.02)
    speed = np.linalg.norm(np.gradient(uniform_filter1d(_at(even, times, bar), 5, axis=0), 0.02, axis=0), axis=1)
    if not (speed > _MOVES).any():
        raise EpisodeError(f"The bar moves at {speed.max():.3f} m/s at most; a recording has one that swings.")
    first, *_, last = even[speed > _MOVES].tolist() * 2
    return first, last


# --- the model -----------------------------------------------------------------------------------------------------------


@cache
def hanging() -> System:
    """The cloth below its bar, whose middle is at the origin; each held node follows a track of its own."""
    flat = grid_cloth(_NODES, _NODES, _SIDE, _SIDE)
    nodes = flat.nodes[:, [0, 2, 1]] - [0.0, 0.0, _SIDE / 2]
    rest = Motion((Keyframe(0.0, (0, 0, 0)), Keyframe(1.0, (0, 0, 0))))
    held = range(_NODES * (_NODES - 1), _NODES**2)  # the last row is the highest
    return build_system(
        replace(flat, nodes=np.ascontiguousarray(nodes)),
        isotropic("cloth", density=_DENSITY, stretching=_STRETCHING, bending=_BENDING, damping=_DAMPING),
        time_step=_STEP,
        handles=Handles(tuple(Handle(node, rest, gripper=f"node{node}") for node in held), hard=True),
        surrounding=Surrounding(air_density=1.2, added_mass=_DENSITY, linear_drag=_DENSITY, self_contact=False),
        integrator="implicit",
    )


def _properties(values: Mapping[str, torch.Tensor]) -> Properties:
    system = hanging()
    return scaled_properties(system.properties, dict(values), faces=torch.as_tensor(system.mesh.faces))


def simulate(track: Floats, values: Mapping[str, float], free: Sequence[str] = ()) -> tuple[Rollout, list[Rollout]]:
    """The motion of multipliers (`PARAMETERS`), and its derivative by the logarithm of each free one.

    Args:
        track: [S, 7, 3] displacement of the held nodes [m].
    """
    moved = torch.as_tensor(track)[None]
    if not free:
        with torch.no_grad():
            return rollout(hanging(), len(track), properties=_properties(_tensors(values)), track=moved), []

    def fields(logs: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return _properties(
            _tensors(values) | {name: log.exp()[None] for name, log in zip(free, logs, strict=True)}
        ).tensors()

    logs = torch.tensor([values[name] for name in free], dtype=torch.float64).log()
    rates = Properties(*(one.movedim(-1, 0).flatten(0, 1) for one in torch.func.jacfwd(fields)(logs)))
    run, moves = rollout_tangents(
        hanging(), len(track), properties=_properties(_tensors(values)), tangents=rates, track=moved
    )
    return run, [replace(run, positions=move) for move in moves]


def _tensors(values: Mapping[str, float]) -> dict[str, torch.Tensor]:
    return {name: torch.tensor([value], dtype=torch.float64) for name, value in values.items()}


# --- the fit -------------------------------------------------------------------------------------------------------------

_POSE = 7
_SCALE = np.array([0.01] * 3 + [0.05] * 3 + [_LATE])
"""Of a pose: shift [m], rotation vector about the bar's start [rad], and lag of all frames [s]."""


def residuals(recording: Recording, run: Rollout, moves: Sequence[Rollout], pose: Floats) -> tuple[Floats, Floats]:
    """Distances [N + 1] of the N recorded points from the cloth [m], with the prior of the lag, and their derivatives
    [N + 1, k + 7] by the k parameters and the pose. The points of a frame share their error: they count as one against the
    prior."""
    system, lag = hanging(), float(pose[6])
    faces = system.mesh.faces
    turn, middle = Rotation.from_rotvec(pose[3:6]).as_matrix(), recording.start.mean(0) + pose[:3]

    def at(moved: Rollout, late: float = 0.0) -> Floats:
        return np.asarray(moved.at(torch.as_tensor(recording.times + lag + late))[0].numpy() @ turn.T)

    nodes = np.ascontiguousarray(at(run) + middle)
    found, weights = find_on_surface(recording.points, NO_GUESS, nodes, faces)
    frames = np.arange(len(nodes))[:, None, None]

    def there(field: Floats) -> Floats:
        return np.asarray((field[frames, faces[found]] * weights[..., None]).sum(2))

    place = there(nodes)
    apart = recording.points - place
    distance = np.sqrt((apart**2).sum(-1) + 1e-12)
    way = -apart / distance[..., None]
    rates = [there(at(move)) for move in moves]
    rates += [np.broadcast_to(axis, place.shape) for axis in np.eye(3)]
    rates += [np.cross(axis, place - middle) for axis in _turning(pose[3:6])]
    rates += [there(at(run, _STEP) - at(run, -_STEP)) / (2 * _STEP)]
    slopes = np.stack([(way * rate).sum(-1)[recording.seen] for rate in rates], 1)
    weight = _NOISE * _ROWS / _LATE
    prior = np.eye(len(rates))[-1:] * weight
    return np.append(distance[recording.seen], lag * weight), np.concatenate([slopes, prior])


def _turning(vector: Floats) -> Floats:
    """[3, 3] the axes about which a rotation turns as each number of its rotation vector grows (left Jacobian)."""
    angle = float(np.linalg.norm(vector))
    cross = np.cross(np.eye(3), vector)  # [3, 3] rows: e_i x v
    a, b = (0.5, 1 / 6) if angle < 1e-6 else ((1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3)
    skew = -cross.T  # v x
    return np.asarray((np.eye(3) + a * skew + b * skew @ skew).T)


def find_pose(recording: Recording, run: Rollout) -> tuple[Floats, float]:
    """The pose [7] of a motion in a recording, and the RMS of the points' distances from the cloth [m]."""
    found = _least(lambda pose: residuals(recording, run, [], pose), np.zeros(_POSE), _SCALE)
    left = residuals(recording, run, [], found)[0][:-1]
    return found, float(np.sqrt((left**2).mean()))


def fit(recordings: Sequence[Recording], values: Mapping[str, float], free: Sequence[str]) -> dict[str, float]:
    """The values with the free ones fitted to several recordings by Gauss and Newton's method, a pose for each."""
    count = len(free)

    def all_residuals(x: Floats) -> tuple[Floats, Floats]:
        tried = dict(values) | dict(zip(free, np.exp(x[:count]).tolist(), strict=True))
        left, slopes = [], []
        for index, one in enumerate(recordings):
            begin = count + _POSE * index
            distance, own = residuals(one, *simulate(one.track, tried, free), x[begin : begin + _POSE])
            whole = np.zeros((len(distance), len(x)))
            whole[:, :count], whole[:, begin : begin + _POSE] = own[:, :count], own[:, count:]
            left.append(distance)
            slopes.append(whole)
        return np.concatenate(left), np.concatenate(slopes)

    poses = [find_pose(one, simulate(one.track, values)[0])[0] for one in recordings]
    start = np.concatenate([np.log([values[name] for name in free]), *poses])
    found = _least(all_residuals, start, np.append(np.full(count, 0.3), np.tile(_SCALE, len(recordings))))
    return dict(values) | dict(zip(free, np.exp(found[:count]).tolist(), strict=True))


def _least(both: Callable[[Floats], tuple[Floats, Floats]], start: Floats, scale: Floats) -> Floats:
    """Where the sum of squares of `both(x)` = (residuals, derivatives) is lowest."""
    last: list[tuple[bytes, tuple[Floats, Floats]]] = []

    def at(x: Floats) -> tuple[Floats, Floats]:
        if not last or last[0][0] != x.tobytes():
            last[:] = [(x.tobytes(), both(x))]
        return last[0][1]

    found = least_squares(lambda x: at(x)[0], start, jac=lambda x: at(x)[1], x_scale=scale, max_nfev=25, ftol=1e-5)
    return np.asarray(found.x)


# --- the study -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Row:
    """What one model makes of all recordings."""

    model: str
    values: Mapping[str, float]
    rms_mm: Mapping[str, float]
    """Of each recording, its pose fitted."""
    period: float
    """[s] Of its free swing."""
    decay: float
    """[1/s]"""


def free_swing(recording: Recording) -> tuple[float, float]:
    """Period [s] and decay [1/s] of the cloth's lower part after the bar has stopped."""
    after = (recording.times > recording.stop + 0.15) & recording.seen[:, -_ROWS:].any(1)
    if after.sum() < 6:
        raise EpisodeError(f"{recording.name} has {after.sum()} clouds of its free swing; six or more are needed.")
    return swing(recording.times[after], _lower_edge(recording)[after, 1])


def _lower_edge(recording: Recording) -> Floats:
    """[F, 3] the middle of the last row; NaN where nothing of it is seen."""
    return _means(recording.points[:, -_ROWS:], recording.seen[:, -_ROWS:])


def simulated_swing(values: Mapping[str, float]) -> tuple[float, float]:
    """The same of the model, after the bar has moved by 1 cm in 0.3 s."""
    moments: Floats = _STEP * np.arange(1.0, 201.0)
    track = np.zeros((len(moments), _NODES, 3))
    track[..., 1] = 0.01 * np.minimum(moments / 0.3, 1.0)[:, None]
    run, _ = simulate(track, values)
    after = moments > 0.3
    return swing(moments[after], run.positions[0, 1:, :_NODES, 1].mean(-1).numpy()[after])


def _row(model: str, recordings: Sequence[Recording], values: Mapping[str, float]) -> Row:
    found = {one.name: 1e3 * find_pose(one, simulate(one.track, values)[0])[1] for one in recordings}
    return Row(model, values, found, *simulated_swing(values))


def study(recordings: Sequence[Recording]) -> tuple[list[Row], dict[str, tuple[float, float]]]:
    """Three models of the air, fitted to `FITTED`; and the recorded free swings of all."""
    three = [one for one in recordings if one.name in FITTED]
    swings = {one.name: free_swing(one) for one in recordings}
    without = dict(_START) | {"added_mass": 1e-6, "damping": _DAMPING}
    still = simulated_swing(without | {"linear_drag": 1e-6, "air_density": 1e-6})[0]
    ratio = (float(np.median([swings[one.name][0] for one in three])) / still) ** 2 - 1
    nuisance = {"bending": 1.0, "damping": _DAMPING}
    free = ("linear_drag", "air_density", *nuisance)
    rows = []
    for model, start, names in (
        ("air_density alone", without | nuisance, free),
        ("added density by the free swing", _START | nuisance | {"added_mass": max(ratio, 1e-3)}, free),
        ("added density by the clouds", _START | nuisance, ("added_mass", *free)),
    ):
        rows.append(_row(model, recordings, fit(three, start, names)))
        typer.echo(f"{model}: median {_median(rows[-1]):.1f} mm", err=True)
    return rows, swings


def _median(row: Row) -> float:
    """Of the recordings that were not fitted [mm]."""
    return float(np.median([rms for name, rms in row.rms_mm.items() if name not in FITTED]))


def _page(rows: Sequence[Row], swings: Mapping[str, tuple[float, float]], figure: str) -> str:
    table = [
        [
            row.model,
            *(f"{row.rms_mm[name]:.1f}" for name in FITTED),
            f"{_median(row):.1f}",
            f"{row.period:.3f}",
            f"{row.decay:.2f}",
            f"{row.values['added_mass']:.2f}",
            f"{row.values['linear_drag']:.2f}",
            f"{1.2 * row.values['air_density'] / _DENSITY:.2f}",
        ]
        for row in rows
    ]
    each = [
        [name, *(f"{row.rms_mm[name]:.1f}" for row in rows), f"{period:.3f}", f"{decay:.2f}"]
        for name, (period, decay) in swings.items()
    ]
    quarter, half, three = np.quantile([period for period, _ in swings.values()], [0.25, 0.5, 0.75])
    head = ["air", *(f"{name} mm" for name in FITTED), "others, median mm", "period s", "decay 1/s"]
    head += ["added density / density", "linear air_density / density 1/s", "air density / density 1/m"]
    heads = ["recording", *(f"{row.model} mm" for row in rows), "recorded period s", "decay 1/s"]
    alone, with_air = rows[:2]
    return result_page(
        "Does air move with a cloth?",
        f"Yes. The real cloth swings freely with a period of {half:.3f} s (median of {len(swings)} swings). The model's "
        f"period is {alone.period:.3f} s without the air that moves along and {with_air.period:.3f} s with it. The median "
        "RMS of the "
        f"{len(swings) - len(FITTED)} predicted recordings falls from {_median(alone):.1f} to {_median(with_air):.1f} mm.",
        markdown_table(head, table),
        note=f"A cloth of {_SIDE:g} × {_SIDE:g} m hangs from a bar. An arm swings the bar three or four times and stops; "
        "then the cloth swings freely. The models were fitted to three recordings. For the others, only the pose was "
        "fitted. Millimetres are RMS distances of the recorded points from the simulated cloth, in all frames from the "
        "first motion of the bar on. Period and decay are those of a small free swing of the model.",
        picture=f"![The lower edge of the cloth over time]({figure})",
        command="make hanging DATA=DIR",
        details={
            "Method": [
                [
                    f"- **Model.** {_NODES} × {_NODES} nodes and steps of {1e3 * _STEP:g} ms. The upper edge follows the "
                    "recorded pose of the bar.",
                    "- **Times.** Clouds are stamped when they are published, about 0.3 s late. The study takes a "
                    "frame's time from its upper edge, which must be where the bar was. The time since the previous "
                    "cloud predicts a part of the delay. Where the bar stands still, this prediction decides alone.",
                    "- **Pose.** Each recording has a shift, a rotation and one lag of all frames (prior "
                    f"{1e3 * _LATE:g} ms).",
                    "- **Fit.** Gauss–Newton with the simulator's own derivatives. Bending and damping are nuisance "
                    "parameters. The density of the cloth is unknown, so the fit only finds ratios to it.",
                    "- **Added density.** In the second row, the period of the free swing in the three recordings "
                    "determines the added density, and their clouds determine the rest. In the third row, the clouds "
                    "determine the added density too.",
                ],
                "`studies/hanging_cloth.py` describes the recordings, which are not part of this repository.",
            ],
            "Each recording": [
                markdown_table(heads, each),
                f"Quartiles of the recorded periods: {quarter:.3f} and {three:.3f} s. A free swing lasts 1 to 2.5 s and "
                "loses most of its amplitude in this time. A single period is known to about 0.05 s.",
            ],
        },
    )


def _figure(recording: Recording, rows: Sequence[Row]) -> bytes:
    """PNG: the lower edge in the direction of the swing, recorded and simulated."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    canvas = Figure(figsize=(9, 3), layout="constrained")
    FigureCanvasAgg(canvas)
    axes = canvas.subplots()
    middle = recording.start.mean(0)
    for row, colour in zip(rows[:2], ("#d55e00", "#2b8ccb"), strict=True):
        run, _ = simulate(recording.track, row.values)
        pose = find_pose(recording, run)[0]
        lower = run.positions[0, :, :_NODES].mean(1).numpy() @ Rotation.from_rotvec(pose[3:6]).as_matrix().T
        axes.plot(run.times.numpy() - pose[6], lower[:, 1] + middle[1] + pose[1], color=colour, label=row.model)
    axes.plot(recording.times, _lower_edge(recording)[:, 1], "k.", markersize=4, label="recorded")
    axes.set(xlim=(recording.times.min(), recording.times.max()), xlabel="time [s]", ylabel="y [m]", title=recording.name)
    axes.legend(loc="upper right")
    png = io.BytesIO()
    canvas.savefig(png, format="png", dpi=110, facecolor="white", metadata={"Software": None})
    return png.getvalue()


def main(
    folder: Annotated[Path, typer.Argument(help="Holds the recordings, NPZ files.")],
    out: Annotated[Path, typer.Option(help="Markdown page; the figure goes beside it.")] = PAGE,
) -> None:
    """Fit the air of a hanging cloth to three recordings and predict the others; write a page. About two minutes."""
    torch.set_num_threads(1)
    try:
        paths = sorted(folder.glob("*.npz"))
        missing = set(FITTED) - {path.stem for path in paths}
        if missing or len(paths) == len(FITTED):
            raise EpisodeError(
                f"{folder} holds {len(paths)} recordings, without {', '.join(sorted(missing)) or 'others to predict'}. "
                f"The study needs NPZ files of {', '.join(FITTED)} and others. Give the folder that holds them."
            )
        recordings = [read_recording(path) for path in paths]
        rows, swings = study(recordings)
        figure = out.with_suffix(".png")
        predicted = next(one for one in recordings if one.name not in FITTED)
        write_bytes(figure, _figure(predicted, rows))
        write_text(out, _page(rows, swings, figure.name))
    except DiffCloudError as error:
        typer.echo(f"Error: {error}", err=True)
        raise typer.Exit(1) from error


if __name__ == "__main__":
    typer.run(main)
