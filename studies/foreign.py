"""How often do intervals hold the truth? Cloths that MuJoCo and Newton move, as depth cameras see them.

    python -m studies foreign --seed SEED [--sets towels,folds] [--count 30] [--out build/foreign]

Every other cloth is drawn from a wide range. `diffcloud fit` fits each recording as a user would; the study writes
what is told into cloth.yaml and recordings.yaml. Motions are kept by seed and every fit is a line of OUT/log.jsonl, so a
study that was interrupted goes on where it ended.

The truth is the stretching stiffness of a strip. MuJoCo's membrane has this simulator's law, so it is the number that
MuJoCo was given. Newton's membrane is neo-Hookean: a strip of it gives way by a tenth more at a strain of 5 % and by a
quarter more at 12 %, with steps of any length. Its truth is measured (`in_a_strip`).
"""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer
import yaml
from numpy.typing import NDArray
from scipy.optimize import brentq

from diffcloud.errors import ConfigError
from diffcloud.evaluation.markdown import markdown_table, result_page
from diffcloud.io.episodes import Episode, write_episode
from diffcloud.io.files import write_npz, write_text
from diffcloud.io.obj import write_surface
from diffcloud.jobs.scene_files import find_scene
from diffcloud.mesh.refinement import refined
from diffcloud.mesh.shapes import grid_cloth, lined_cloth
from diffcloud.mesh.simplified import cloth_of
from diffcloud.mesh.topology import ClothMesh, SurfaceMesh
from diffcloud.scene.scenarios.grid import GridScenario
from diffcloud.sensing.cameras import looking_at
from diffcloud.sensing.recorder import caster
from diffcloud.sim.motion import Keyframe, Motion
from diffcloud.simulators import mujoco, newton, ours
from diffcloud.simulators.problem import REST_HEIGHT, Problem, Sheet, installed
from diffcloud.simulators.problems import strip
from studies.mujoco_towels import COUNTS, one_way

Floats = NDArray[np.float64]
Kind = Literal["lift", "fold", "pair", "shirt", "skirt", "vest"]
Simulator = Literal["mujoco", "newton", "diffcloud"]

COLUMNS, ROWS = COUNTS
"""Nodes of the foreign cloth."""
_SECONDS, _RATE, _KEYS = 1.5, 10.0, 81
_NOISE = 0.002
"""[m] Of a point, along each axis."""
_FOCAL, _WIDTH, _HEIGHT = 210.0, 320, 200
"""[px] Of a camera: at 0.8 m pixels are 4 mm apart."""
_CUT = 0.005
"""[m] Above the table, where clouds end in the set `cut`."""
_WRONG = 1.5
"""Factor by which the pad's size is wrong in the set `untold`."""
_NEWTON_STEP = 1e-4
"""[s] Longer ones make a strip too stiff."""
_Z90 = 1.645
_GARMENT_M = 0.021
"""Largest edge of a garment's grid [m], about that of a towel."""
_OUTLINES: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "shirt": ((0.0, 0.11, 0.39, 0.5), (0.0, 0.30, 0.44)),
    "vest": ((0.0, 0.04, 0.12, 0.24, 0.32, 0.36), (0.0, 0.24, 0.32, 0.44)),
    "skirt": ((0.0, 0.34), (0.0, 0.32)),
}
"""Lines of a garment across and along, at which its outline turns [m]."""
_ABSENT = {"shirt": {(0, 0), (2, 0)}, "vest": {(0, 1), (4, 1), (0, 2), (2, 2), (4, 2)}, "skirt": set()}
"""Rectangles between these lines that are no cloth."""
_SHOULDER = {"shirt": 0.37, "vest": 0.31, "skirt": 0.31}
"""Position across of the point that is held, at the upper end [m]."""
_TAPER = 0.3
"""Part of its width that a skirt loses up to the waist."""
_GAP_M: float = GridScenario.model_fields["gap_m"].default


@dataclass(frozen=True)
class Set:
    """Recordings that are fitted under the same conditions."""

    name: str
    about: str
    kind: Kind = "lift"
    simulator: Simulator = "mujoco"
    motions: tuple[int, ...] = (0,)
    """Of one cloth, fitted together."""
    cameras: int = 2
    cut: bool = False
    told: bool = True
    """Place, yaw and sizes of cloth and pad; else the pad's size is wrong and the others are found."""
    most: int = 30
    """Cloths at most."""


SETS = (
    Set("towels", "lifted by a corner; size, place, yaw and pad known"),
    Set("cut", "the same lifts, points below 5 mm above the table removed", cut=True),
    Set("one_camera", "the same lifts, seen by one camera", cameras=1),
    Set(
        "untold",
        "the same lifts; size, place and yaw unknown, the pad's size stated 1.5 times too large or too small",
        told=False,
    ),
    Set("folds", "folded over by a corner", kind="fold", most=10),
    Set("newton", "lifted by a corner, moved by Newton", simulator="newton", most=10),
    Set("shirts", "T-shirts of one layer, lifted by a shoulder; mesh, pad and track told", kind="shirt", most=3),
    Set("vests", "vests of one layer, lifted by a strap; mesh, pad and track told", kind="vest", most=3),
    Set("skirts", "skirts of one layer, lifted at the waist; mesh, pad and track told", kind="skirt", most=3),
    Set("pairs", "held at two corners by two grippers; size, pad and tracks told", kind="pair", most=6),
    Set("finer", "the lifts of towels, moved by this simulator on 49 × 37 nodes", simulator="diffcloud", most=40),
    Set("joint", "two lifts of each towel, fitted together", motions=(0, 1), most=10),
)


@dataclass(frozen=True)
class Cloth:
    """A cloth with a random material, moved by a pad, or by two, in one of its motions."""

    seed: int
    kind: Kind = "lift"
    motion: int = 0

    @cached_property
    def wide(self) -> bool:
        return self.seed % 2 == 1

    @cached_property
    def _own(self) -> dict[str, Any]:
        rng = np.random.default_rng([self.seed, 1])

        def between(low: float, high: float) -> float:
            return float(np.exp(rng.uniform(np.log(low), np.log(high))))

        stretching, friction, density, poisson = (
            (between(3, 2000), float(rng.uniform(0.1, 1.0)), between(0.05, 0.6), float(rng.uniform(0, 0.45)))
            if self.wide
            else (between(8, 120), float(rng.uniform(0.2, 0.8)), between(0.12, 0.35), float(rng.uniform(0, 0.35)))
        )
        sheet = Sheet(density, stretching, poisson, between(8e-7, 1.5e-5), between(0.001, 0.006))
        size = (float(rng.uniform(0.26, 0.44)), float(rng.uniform(0.22, 0.34)))
        return {"sheet": sheet, "friction": friction, "size": size, "pad_wrong": bool(rng.integers(2))}

    @cached_property
    def sheet(self) -> Sheet:
        sheet: Sheet = self._own["sheet"]
        return sheet

    @property
    def friction(self) -> float:
        return float(self._own["friction"])

    @property
    def garment(self) -> bool:
        return self.kind in _OUTLINES

    @property
    def size(self) -> tuple[float, float]:
        """Of a rectangle, along the columns and along the rows [m]."""
        across, along = self._own["size"]
        return float(across), float(along)

    @cached_property
    def mesh(self) -> ClothMesh:
        """Of the simulator, level, with its middle above the origin [m]."""
        if self.garment:
            return _garment(self.kind)
        flat = grid_cloth(ROWS, COLUMNS, self.size[1], self.size[0])
        mesh = replace(flat, nodes=np.column_stack([flat.nodes[:, :2], np.full(len(flat.nodes), REST_HEIGHT)]))
        return one_way(mesh, COLUMNS, through=True)

    @property
    def held(self) -> list[list[int]]:
        """Nodes of each gripper: of one cell."""
        if self.garment:
            return [_cell_at(self.mesh, self.kind)]
        right = [COLUMNS * row + column for row in (ROWS - 2, ROWS - 1) for column in (COLUMNS - 2, COLUMNS - 1)]
        left = [COLUMNS * row + column for row in (ROWS - 2, ROWS - 1) for column in (0, 1)]
        return [right, left] if self.kind == "pair" else [right]

    @property
    def pad(self) -> float:
        """Side of a square of the held cell's area [m]."""
        if self.garment:
            area = self.mesh.face_area[np.isin(self.mesh.faces, self.held[0]).all(axis=1)].sum()
            return math.sqrt(area)
        return math.sqrt(self.size[0] / (COLUMNS - 1) * self.size[1] / (ROWS - 1))

    @property
    def stated_pad(self) -> float:
        """Of the set `untold` [m]."""
        return self.pad * (_WRONG if self._own["pad_wrong"] else 1 / _WRONG)

    @cached_property
    def place(self) -> tuple[Floats, float, float]:
        """Centre on the table [m], yaw [deg], height of the table [m]."""
        rng = np.random.default_rng([self.seed, 2, self.motion])
        centre = np.array([0.55, 0.0]) + rng.uniform(-0.03, 0.03, 2)
        return centre, float(rng.uniform(-15, 15)), float(rng.uniform(-0.02, 0.05))

    @cached_property
    def eyes(self) -> Floats:
        """[2, 3] of cameras on both sides, that look at the cloth [m]."""
        rng = np.random.default_rng([self.seed, 3, self.motion])
        around = np.array([rng.uniform(0.15, 1.35), rng.uniform(3.3, 4.5)]) + np.radians(90)
        away, up = rng.uniform(0.5, 0.75, 2), rng.uniform(0.5, 0.8, 2)
        return np.stack([0.55 + away * np.cos(around), away * np.sin(around), up], axis=1)

    @property
    def paths(self) -> list[Motion]:
        """Of each pad, in the cloth's own axes. A second pad rises less, and comes nearer as it does."""
        first = self.path
        if self.kind != "pair":
            return [first]
        rng = np.random.default_rng([self.seed, 6, self.motion])
        share, nearer = rng.uniform(0.75, 0.95), rng.uniform(0.15, 0.3) * self.size[0]
        times = np.linspace(0, _SECONDS, _KEYS)
        moved = first.at(times)[1] * [1, 1, share]
        moved[:, 0] += nearer * _smooth(times / _SECONDS)
        keys = zip(times.tolist(), moved.tolist(), strict=True)
        return [first, Motion(tuple(Keyframe(time, (x, y, z)) for time, (x, y, z) in keys))]

    @property
    def path(self) -> Motion:
        """Of the first pad, in the cloth's own axes."""
        rng = np.random.default_rng([self.seed, 4, self.motion])
        times = np.linspace(0, _SECONDS, _KEYS)
        if self.kind == "fold":
            share, rise, lasts = rng.uniform(0.55, 0.85), rng.uniform(0.3, 0.5), rng.uniform(1.4, 2.0)
            turn = np.pi * _smooth(times / lasts)
            far = np.array(self.size) * rng.uniform([0.7, 0.5], [1.0, 1.0]) * share
            across, along = -np.outer(far, (1 - np.cos(turn)) / 2)
            moved = np.stack([across, along, rise * np.linalg.norm(far) * np.sin(turn)], axis=1)
        else:
            up, lasts, lag = rng.uniform(0.25, 0.42), rng.uniform(1.6, 2.6), rng.uniform(0, 0.5)
            aside = np.outer(_smooth((times - lag) / lasts), [rng.uniform(-0.14, 0.05), rng.uniform(-0.12, 0.08)])
            moved = np.column_stack([aside, up * _smooth(times / lasts)])
        keys = zip(times.tolist(), moved.tolist(), strict=True)
        return Motion(tuple(Keyframe(time, (x, y, z)) for time, (x, y, z) in keys))


def _garment(kind: str) -> ClothMesh:
    """A garment of one layer, level, at rest height."""
    across, along = (_lines(ends) for ends in _OUTLINES[kind])
    flat = lined_cloth(across, along)
    middle = flat.verts[flat.face_verts].mean(axis=1)
    cells = [np.searchsorted(ends, middle[:, axis]) - 1 for axis, ends in enumerate(_OUTLINES[kind])]
    kept = [cell not in _ABSENT[kind] for cell in zip(*(one.tolist() for one in cells), strict=True)]
    nodes, faces = np.column_stack([flat.verts, np.zeros(len(flat.verts))]), flat.face_verts[kept]
    used, faces = np.unique(faces, return_inverse=True)
    nodes, faces = nodes[used], faces.reshape(-1, 3)
    middle_x = across[-1] / 2
    if kind == "skirt":
        nodes[:, 0] = middle_x + (nodes[:, 0] - middle_x) * (1 - _TAPER * nodes[:, 1] / along[-1])
    shift = [middle_x, along[-1] / 2, -REST_HEIGHT]
    return cloth_of(SurfaceMesh(nodes - shift, faces))


def _lines(ends: Sequence[float]) -> Floats:
    parts = [np.linspace(a, b, max(round((b - a) / _GARMENT_M), 1), endpoint=False) for a, b in pairwise(ends)]
    return np.array([*np.concatenate(parts), ends[-1]])


def _cell_at(mesh: ClothMesh, kind: str) -> list[int]:
    """Nodes of the cell at the held point."""
    across, along = (_lines(ends) for ends in _OUTLINES[kind])
    column = int(np.searchsorted(across, _SHOULDER[kind])) - 1
    x = across[[column, column + 1]] - across[-1] / 2
    y = along[-2:] - along[-1] / 2
    narrow = 1 - _TAPER * along[-2:] / along[-1] if kind == "skirt" else np.ones(2)
    wanted = np.array([[one * part, height] for part, height in zip(narrow, y, strict=True) for one in x])
    return np.flatnonzero(np.linalg.norm(mesh.nodes[:, None, :2] - wanted, axis=2).min(axis=1) < 1e-6).tolist()


def _smooth(share: Floats) -> Floats:
    share = np.clip(share, 0, 1)
    return np.asarray(share**3 * (10 - 15 * share + 6 * share**2))


@dataclass(frozen=True)
class Moved:
    """A foreign motion in the world [m]."""

    nodes: Floats
    """[T, V, 3]"""
    faces: NDArray[np.int64]
    pads: Floats
    """[T, G, 3] middle of the nodes that each gripper holds."""


def moved(cloth: Cloth, simulator: Simulator, cache: Path) -> Moved:
    """The motion of a cloth, simulated once and kept."""
    path = cache / f"{simulator}-{cloth.kind}-{cloth.seed}-{cloth.motion}.npz"
    problem = _problem(cloth)
    if simulator == "diffcloud":
        problem = _finer(problem)
    if path.is_file():
        with np.load(path) as kept:
            nodes = kept["nodes"].astype(np.float64)
    else:
        if simulator == "mujoco":
            settings, sheet = mujoco.stable(problem)
            nodes = mujoco.simulate(replace(problem, sheet=sheet), settings).nodes
        elif simulator == "diffcloud":
            nodes = ours.simulate(problem).nodes
        else:
            nodes = newton.simulate(problem, newton.Settings(step=_NEWTON_STEP)).nodes
        nodes = nodes.astype(np.float32)
        if not np.isfinite(nodes).all():
            raise ConfigError(f"{simulator} did not simulate the {cloth.kind} of cloth {cloth.seed}.")
        write_npz(path, nodes=nodes)
    centre, yaw, table = cloth.place
    cosine, sine = math.cos(math.radians(yaw)), math.sin(math.radians(yaw))
    turn = np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])
    middle = problem.mesh.nodes.mean(0) * [1, 1, 0]
    world = (nodes - middle) @ turn + [*centre, table]
    pads = np.stack([world[:, held].mean(1) for held in cloth.held], axis=1)
    return Moved(world, problem.mesh.faces, pads)


def in_a_strip(cloth: Cloth, motion: Moved, cache: Path) -> float:
    """The stretching that a strip of Newton's sheet shows at the strain of a motion, measured once and kept [N/m].

    The strip hangs under its weight. That stiffness is meant with which the law of Saint Venant and Kirchhoff stretches it
    as far: N = E h λ (λ² - 1)/2 at the stretch λ. The strain of the motion is the root of the mean square of the larger
    principal one, over area and frames. Near the pad strains are several times that, and the sheet is softer still.
    """
    path = cache / f"strip-{cloth.kind}-{cloth.seed}-{cloth.motion}.npz"
    if path.is_file():
        with np.load(path) as kept:
            return float(kept["stretching"])
    known, strain = strip(cloth.sheet), _strain(cloth, motion)
    linear = known.theory["elongation"]
    hung = replace(known.problem, gravity=known.problem.gravity * strain / linear, seconds=0.24 * known.problem.seconds)
    seen_so = known.measures(newton.simulate(hung, newton.Settings(step=_NEWTON_STEP)))["elongation"]
    stretches, load = np.linspace(1, 3, 20001), 2 * strain * (np.arange(100) + 0.5) / 100  # over E h, from the free end up

    def too_long(log: float) -> float:
        laws = stretches * (stretches**2 - 1) / 2
        return float(np.interp(load / math.exp(log), laws, stretches).mean()) - 1 - seen_so

    found = cloth.sheet.stretching * math.exp(brentq(too_long, -2.0, 2.0))
    write_npz(path, stretching=np.array(found))
    return found


def _strain(cloth: Cloth, motion: Moved) -> float:
    mesh = cloth.mesh
    corner = motion.nodes[:, motion.faces]
    edges = np.stack([corner[:, :, 1] - corner[:, :, 0], corner[:, :, 2] - corner[:, :, 0]], axis=-1)
    larger = np.linalg.svd(edges @ np.linalg.inv(mesh.material_edges), compute_uv=False)[..., 0] - 1
    return float(np.sqrt(np.average((larger**2).mean(0), weights=mesh.face_area)))


def _problem(cloth: Cloth) -> Problem:
    return Problem(
        "cloth",
        cloth.mesh,
        cloth.sheet,
        _SECONDS,
        {node: path for held, path in zip(cloth.held, cloth.paths, strict=True) for node in held},
        table=0.0,
        friction=cloth.friction,
        self_contact=cloth.kind == "fold",
        rate=_RATE,
    )


def _finer(problem: Problem) -> Problem:
    """The problem on a mesh of half the edge length. Grippers hold the same part of the cloth."""
    mesh, edges = refined(problem.mesh)
    first, held = len(problem.mesh.nodes), problem.held
    between = {first + index: held[a] for index, (a, b) in enumerate(edges.tolist()) if a in held and b in held}
    return replace(problem, mesh=mesh, held={**held, **between})


def seen(motion: Moved, cloth: Cloth, cameras: int, *, cut: bool) -> Episode:
    """The motion as clouds: what each pixel of each camera sees, with noise."""
    rng = np.random.default_rng([cloth.seed, 5, cloth.motion])
    eyes, table = cloth.eyes[:cameras], cloth.place[2]
    rays = [_rays(eye) for eye in eyes]
    frames = []
    for nodes in motion.nodes:
        scene, points = caster([SurfaceMesh(nodes, motion.faces)]), []
        for one in rays:
            far = scene.cast_rays(one)["t_hit"].numpy()
            met = np.isfinite(far)
            points.append(one[met, :3] + far[met, None] * one[met, 3:])
        cloud = np.concatenate(points).astype(np.float64)
        cloud += rng.normal(scale=_NOISE, size=cloud.shape)
        frames.append(cloud[cloud[:, 2] > table + _CUT] if cut else cloud)
    times = np.arange(len(frames)) / _RATE
    meta = {"viewpoints": {f"camera_{index}": eye.tolist() for index, eye in enumerate(eyes)}}
    grippers = ("a", "b")[: motion.pads.shape[1]]
    return Episode.from_frames(frames, times, gripper=motion.pads, grippers=grippers, meta=meta)


def _rays(eye: Floats) -> NDArray[np.float32]:
    """[H, W, 6] of the pixels of a camera that looks at the middle of the motion."""
    right, down, forward = looking_at(eye, [0.52, 0.0, 0.12])[:3, :3].T
    x = (np.arange(_WIDTH) + 0.5 - _WIDTH / 2) / _FOCAL
    y = (np.arange(_HEIGHT) + 0.5 - _HEIGHT / 2) / _FOCAL
    ways = forward + x[None, :, None] * right + y[:, None, None] * down
    return np.concatenate([np.broadcast_to(eye, ways.shape), ways], axis=-1).astype(np.float32)


@dataclass(frozen=True)
class Case:
    """One line of the log: a fit of one cloth."""

    set: str
    seed: int
    truth: float
    """Stretching of a strip [N/m]"""
    stated: bool
    """Whether there is a valid interval."""
    value: float
    low: float
    high: float
    at_upper: bool
    """Whether the interval ends at the bound of the search."""
    status: str
    seconds: float
    """Of processor time."""
    message: str
    revision: str
    bending: tuple[float, float, float] | None = None
    """True value and ends of the interval of bending [N·m]. None for Newton, whose law differs, and without an interval."""

    @property
    def bending_held(self) -> bool:
        return self.bending is not None and self.bending[1] <= self.bending[0] <= self.bending[2]

    @property
    def held(self) -> bool:
        return self.stated and self.low <= self.truth and (self.at_upper or self.truth <= self.high)

    @property
    def error(self) -> float:
        """Logarithm of the value over the truth."""
        return math.log(self.value / self.truth)

    @property
    def factor(self) -> float:
        """Half-width of the interval."""
        return math.sqrt(self.high / self.low)

    @property
    def z(self) -> float:
        middle = 0.5 * math.log(self.high * self.low)
        return (middle - math.log(self.truth)) / (math.log(self.factor) / _Z90)


def fitted(one: Set, seed: int, out: Path, revision: str) -> Case:
    """A cloth simulated, recorded, and identified by the command."""
    cloths = [Cloth(seed, one.kind, motion) for motion in one.motions]
    folder = out / "fits" / f"{one.name}-{seed}"
    shutil.rmtree(folder, ignore_errors=True)
    names = {f"{'abc'[cloth.motion]}": cloth for cloth in cloths}
    paths = [folder / f"{name}.npz" for name in names]
    for path, cloth in zip(paths, cloths, strict=True):
        write_episode(path, seen(moved(cloth, one.simulator, out / "motions"), cloth, one.cameras, cut=one.cut))
    _tell(one, folder / "found", names, paths)
    command = [sys.executable, "-m", "diffcloud", "fit", *map(str, paths), "--out", str(folder / "found")]
    command += ["--density", f"{cloths[0].sheet.density:.4f}", "--budget", "none", "--json"]
    with (folder / "messages.txt").open("wb") as messages, (folder / "result.json").open("wb") as result:
        process = subprocess.Popen(command, stdout=result, stderr=messages)
        _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    truth, seconds = cloths[0].sheet.stretching, used.ru_utime + used.ru_stime
    if one.simulator == "newton":
        truth = in_a_strip(cloths[0], moved(cloths[0], one.simulator, out / "motions"), out / "motions")
    if process.returncode != 0:
        said = (folder / "messages.txt").read_text().strip().splitlines()[-3:]
        return Case(one.name, seed, truth, False, 1.0, 1.0, 1.0, False, "failed", seconds, " ".join(said), revision)
    told = json.loads((folder / "result.json").read_text())
    found = told["parameters"]["stretching"]
    stated = found["low"] is not None and found["status"] != "model_error"
    low, high = (found["low"], found["high"]) if stated else (found["value"], found["value"])
    upper = stated and high >= _upper(folder / "found")
    bent = told["parameters"]["bending"]
    bending = None
    if stated and one.simulator != "newton" and bent["low"] is not None:
        bending = (cloths[0].sheet.bending, bent["low"], bent["high"])
    return Case(
        one.name,
        seed,
        truth,
        stated,
        found["value"],
        low,
        high,
        upper,
        found["status"],
        seconds,
        told["reason"],
        revision,
        bending,
    )


def _upper(found: Path) -> float:
    """The largest stretching that the fit tried [N/m]."""
    told = json.loads((found / "fit.json").read_text())["parameters"]["stretching"]
    return 0.99 * float(told["bounds"][1])


def _tell(one: Set, found: Path, names: dict[str, Cloth], paths: Sequence[Path]) -> None:
    """Write what is known into cloth.yaml and recordings.yaml."""
    first = next(iter(names.values()))
    size = first.size if one.told and not first.garment else None
    found.mkdir(parents=True, exist_ok=True)
    for name in ("cloth.yaml", "recordings.yaml"):
        (found / name).unlink(missing_ok=True)
    mesh = found / "cloth.obj" if first.garment else None
    if mesh is not None:  # of the same shape, as fine as a program for garments exports it
        finer, _ = refined(first.mesh)
        write_surface(mesh, SurfaceMesh(finer.nodes, finer.faces))
    if one.told and one.kind in ("lift", "fold"):
        blocks = {name: _told(cloth) for name, cloth in names.items()}
        write_text(found / "recordings.yaml", yaml.safe_dump(blocks))
    find_scene(paths, found, size, first.sheet.density, mesh=mesh)
    cloth = yaml.safe_load((found / "cloth.yaml").read_text())
    cloth["grip_m"] = first.pad if one.told else first.stated_pad
    cloth["air"] = "none"  # neither simulator has any
    if one.told:
        cloth["grip_known_within"] = 1.0
    if one.kind == "fold":
        cloth["self_contact"] = True
    write_text(found / "cloth.yaml", yaml.safe_dump(cloth))
    if not one.told:
        (found / "recordings.yaml").unlink()


def _told(cloth: Cloth) -> dict[str, Any]:
    """What a layout holds."""
    centre, yaw, table = cloth.place
    end = cloth.path.at(np.array([_SECONDS]))[1][0]
    return {
        "center_m": centre.tolist(),
        "yaw_deg": yaw,
        "initial_state": "none",
        "table_height_m": table + REST_HEIGHT - _GAP_M,
        "grasped": ["right_top"],
        "rate_hz": _RATE,
        "frames": round(_SECONDS * _RATE),
        "path": [[0.0, 0.0, 0.0, 0.0], [_SECONDS, *(round(float(x), 4) for x in end)]],
    }


def _revision() -> str:
    return subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=True).stdout.strip()


app = typer.Typer(pretty_exceptions_enable=False)


@app.command()
def main(
    seed: Annotated[
        int | None, typer.Option(min=0, help="Of the first cloth. Default: digits of the commit's hash.")
    ] = None,
    sets: Annotated[str, typer.Option(help="Comma-separated names of sets of recordings.")] = "towels",
    count: Annotated[int, typer.Option(min=1, help="Cloths of each set at most.")] = 30,
    out: Annotated[Path, typer.Option(help="Folder of motions, fits and the log.")] = Path("build/foreign"),
    markdown: Annotated[Path | None, typer.Option(help="Page of results.")] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Fits at once.")] = 2,
) -> None:
    """Fit cloths that other simulators move, and count how often the interval holds the truth."""
    installed()
    chosen = [next((one for one in SETS if one.name == name.strip()), None) for name in sets.split(",")]
    if None in chosen:
        raise ConfigError(f"--sets {sets}: known are {', '.join(one.name for one in SETS)}.")
    revision = _revision()
    first = int(revision[:5], 16) if seed is None else seed
    log = out / "log.jsonl"
    known = _read(log)
    wanted = [(one, first + number) for one in chosen if one for number in range(min(count, one.most))]
    missing = [(one, number) for one, number in wanted if (one.name, number, revision) not in known]
    log.parent.mkdir(parents=True, exist_ok=True)
    os.environ["OMP_NUM_THREADS"] = "1"
    with ThreadPoolExecutor(jobs) as pool:
        waiting = [pool.submit(fitted, one, number, out, revision) for one, number in missing]
        try:
            for done in as_completed(waiting):
                case = done.result()
                with log.open("a") as file:
                    file.write(json.dumps(asdict(case)) + "\n")
                known[case.set, case.seed, revision] = case
                print(_line(case), flush=True)
        finally:
            for one in waiting:
                one.cancel()
    cases = [known[one.name, number, revision] for one, number in wanted]
    page = _page(cases, first, count, revision)
    print(page)
    if markdown is not None:
        write_text(markdown, page)


def _read(log: Path) -> dict[tuple[str, int, str], Case]:
    lines = log.read_text().splitlines() if log.is_file() else []
    cases = [Case(**json.loads(line)) for line in lines]
    return {(case.set, case.seed, case.revision): case for case in cases}


def _line(case: Case) -> str:
    if not case.stated:
        return f"{case.set} {case.seed}: truth {case.truth:.1f}, {case.status}: {case.message}, {case.seconds:.0f} s"
    told = f"truth {case.truth:.1f}, {case.value:.1f} [{case.low:.1f} {case.high:.1f}]"
    return f"{case.set} {case.seed}: {told} {'held' if case.held else 'MISSED'}, z {case.z:+.1f}, {case.seconds:.0f} s"


def _page(cases: Sequence[Case], seed: int, count: int, revision: str) -> str:
    head = [
        "set",
        "held",
        "median abs. log error",
        "mean log error",
        "median half-width",
        "RMS of z",
        "bending held",
        "CPU s",
    ]
    rows = []
    for one in SETS:
        own = [case for case in cases if case.set == one.name]
        if own:
            rows.append([one.name, *_summary(own)])
    if len(rows) > 1:
        rows.append(["all", *_summary(cases)])
    each = [
        [
            case.set,
            case.seed,
            f"{case.truth:.1f}",
            f"{case.value:.1f}" if case.stated else "",
            f"{case.low:.1f} to {'any' if case.at_upper else f'{case.high:.1f}'}" if case.stated else case.message,
            "yes" if case.held else "no",
            case.status,
        ]
        for case in cases
    ]
    sets = [one for one in SETS if any(case.set == one.name for case in cases)]
    return result_page(
        "Do intervals contain the true stiffness of cloths that other simulators move?",
        f"90 % intervals contain it in {', '.join(f'{row[1]} ({row[0]})' for row in rows)} recordings.",
        markdown_table(head, rows),
        note=f"Random cloths of {COLUMNS} × {ROWS} nodes are moved by MuJoCo or Newton, without air, and seen by depth "
        f"cameras with {1e3 * _NOISE:.0f} mm of noise. `diffcloud fit` estimates the stretching stiffness with known "
        "density and unknown friction and bending. *Bending held* counts intervals of bending, all other columns are "
        "about stretching. Odd seeds have wide ranges of material: 3 to 2,000 N/m. *Held* counts intervals that contain "
        "the true value; a fit without one, or with a model error, counts as not held. Errors are logarithms, half-widths "
        "are factors.\n\n" + "\n".join(f"- *{one.name}*: {one.about}." for one in sets),
        made=f"{datetime.now(UTC).date()} at commit {revision[:12]}",
        command=f"python -m studies foreign --sets {','.join(one.name for one in sets)} --seed {seed} --count {count}",
        details={
            "Each fit": [markdown_table(["set", "seed", "true N/m", "found", "interval", "held", "status"], each)],
        },
    )


def _summary(cases: Sequence[Case]) -> list[str]:
    stated = [case for case in cases if case.stated]
    errors = np.array([case.error for case in stated])
    factors = [case.factor for case in stated]
    z = np.array([case.z for case in stated])
    bent = [case for case in cases if case.bending is not None]
    return [
        f"{sum(case.held for case in cases)} of {len(cases)}",
        f"{np.median(np.abs(errors)):.2f}" if stated else "",
        f"{errors.mean():+.2f}" if stated else "",
        f"{np.median(factors):.2f}" if stated else "",
        f"{np.sqrt((z**2).mean()):.2f}" if stated else "",
        f"{sum(case.bending_held for case in bent)} of {len(bent)}" if bent else "",
        f"{np.median([case.seconds for case in cases]):.0f}",
    ]


if __name__ == "__main__":
    app()
