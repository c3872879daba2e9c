"""The pictures of docs/concepts.md, from the first lift of `make repro` and its fit: `make pictures`."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from diffcloud.estimation.batches import batch_losses
from diffcloud.estimation.objective import Objective
from diffcloud.estimation.parameters import FitSpace
from diffcloud.estimation.priors import DEFAULT_FACTOR
from diffcloud.estimation.record import read_fit
from diffcloud.estimation.uncertain import MATERIAL_UNCERTAINTY
from diffcloud.io.episodes import read_episode
from diffcloud.reporting.figures import INK, new_canvas, svg_of
from diffcloud.scene import load_scenario
from diffcloud.sim.properties import one_set

ROOT = Path(__file__).parents[2]
RECORDED, CLOTH, HIDDEN, BELOW = "#8c96a3", "#2b8ccb", "#d55e00", "#009e73"
FRAME = 14
DISPLACED = {"x": 0.03, "y": -0.02, "yaw": np.radians(10.0)}
"""Where the first picture's cloth lies beside its place [m, rad]."""
WIDTH = 7.2
"""[inch]"""
SHOWN = 700
"""Points of a cloud that are drawn."""
PRIORS = dict.fromkeys(("stretching", "density"), DEFAULT_FACTOR) | {
    name: MATERIAL_UNCERTAINTY[name] for name in ("bending", "air_density")
}
"""Factor of one standard deviation by default, of what is asked for and of what is not."""
mpl.rcParams.update({"font.size": 9, "text.color": INK})


def main() -> None:
    lift = load_scenario("lift")
    episode, fit = (ROOT / "data" / kind / "lift" for kind in ("episodes", "fits"))
    objective = Objective(lift, read_episode(episode / "lift_hidden1.npz"))
    values = read_fit(fit / "lift_hidden1.json").values
    pose(objective, values)
    view(Objective(lift, objective.episode, points=SHOWN), values)
    priors(objective, values)


def pose(objective: Objective, values: dict[str, float]) -> None:
    """A motion beside its recording, before its pose is found and after."""
    canvas, axes = new_canvas(2, height=3.1, width=WIDTH)
    run = objective.simulate_to_loss(one_set(values))
    space = objective.pose_space
    found = objective.pose(run)
    beside = found + torch.tensor([[DISPLACED.get(name, 0.0) for name in space.names]])
    cloud = torch.from_numpy(_cloud(objective)).double()
    # the recording is displaced, and with it the pose at which the motion meets it
    displaced = space.moved(space.back(cloud, found), beside)[0].numpy()
    none = torch.zeros_like(found)
    for axis, place, title in zip(axes, (none, beside), ("as the scene has it", "with the pose found"), strict=True):
        nodes = objective.posed_nodes(run, place)[FRAME]
        axis.scatter(displaced[:, 0], displaced[:, 1], s=2, color=RECORDED, linewidths=0, label="recorded")
        axis.triplot(nodes[:, 0], nodes[:, 1], objective.system.mesh.faces, color=CLOTH, linewidth=0.6, label="simulated")
        axis.set_title(title, fontsize=9)
        axis.set(xlim=(-0.22, 0.24), ylim=(-0.14, 0.13))
        _metres(axis, "x [m]", "y [m]")
    told = f"x {1e3 * DISPLACED['x']:.0f} mm, y −{-1e3 * DISPLACED['y']:.0f} mm, yaw 10°"
    axes[1].annotate(told, (0.03, 0.03), xycoords="axes fraction")
    axes[0].legend(frameon=False, labelcolor=INK, fontsize=8, markerscale=3)
    _save(canvas, "pose")


def view(objective: Objective, values: dict[str, float]) -> None:
    """Which sampled points of one frame count, beside what was recorded."""
    canvas, (axis,) = new_canvas(1, height=3.4, width=WIDTH)
    motion = objective.match(objective.simulate_to_loss(one_set(values)))
    frame = objective.frames.index(FRAME)
    pairs = motion.pairs[0]
    points = objective.pose_space.moved(pairs.places.of(motion.shown(objective.pose_space)), motion.pose)[0, frame].numpy()
    counts = pairs.weights[0, frame].numpy() > 0
    below = points[:, 2] < objective.cut if objective.cut is not None else np.zeros_like(counts)
    cloud = _cloud(objective)
    axis.scatter(cloud[:, 0], cloud[:, 2], s=2, color=RECORDED, linewidths=0, label="recorded")
    for chosen, colour, label in (
        (counts, CLOTH, "simulated, counts"),
        (~counts & ~below, HIDDEN, "simulated, no camera\ncould have shown it"),
        (~counts & below, BELOW, "simulated, below where\nthe recording ends"),
    ):
        if chosen.any():
            axis.scatter(points[chosen, 0], points[chosen, 2], s=7, color=colour, linewidths=0, label=label)
    _metres(axis, "x [m]", "z [m]")
    _legend_beside(axis)
    _save(canvas, "view")


def priors(objective: Objective, values: dict[str, float]) -> None:
    """The loss beside the best place, where one, two or four parameters are multiplied by one factor."""
    canvas, (axis,) = new_canvas(1, height=3.2, width=WIDTH)
    factors = torch.logspace(-1, 1, 41, dtype=torch.float64)
    best = torch.tensor([values.get(name, 1.0) for name in PRIORS], dtype=torch.float64)
    bounds = dict.fromkeys(PRIORS, (1e-3, 1e3))
    bare, known = (FitSpace.build(list(PRIORS), bounds=bounds, priors=given) for given in (None, PRIORS))
    for count, space, style, colour, label in (
        (1, bare, "-", HIDDEN, "stretching alone"),
        (2, bare, "-", BELOW, "stretching and density"),
        (4, bare, "-", CLOTH, "stretching, density, bending and air_density"),
        (4, known, "--", CLOTH, "the same, with the priors"),
    ):
        moved = (torch.arange(len(PRIORS)) < count).double()
        losses = batch_losses(objective, space, best * factors[:, None] ** moved)
        axis.plot(factors, 1e3 * losses.sqrt(), style, color=colour, label=label)
    axis.set_xscale("log")
    axis.set_xlabel("factor")
    axis.set_ylabel("root of the loss [mm]")
    axis.set_ylim(0, 8)
    _legend_beside(axis)
    _save(canvas, "priors")


def _cloud(objective: Objective) -> np.ndarray:
    """[P, 3] some of the recorded points of the frame."""
    points = objective.episode.frame(FRAME)
    return points[np.random.default_rng(0).permutation(len(points))[:SHOWN]]


def _legend_beside(axis: Axes) -> None:
    axis.legend(frameon=False, labelcolor=INK, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), markerscale=2)


def _metres(axis: Axes, x: str, y: str) -> None:
    axis.set_aspect("equal")
    axis.set_xlabel(x)
    axis.set_ylabel(y)


def _save(canvas: Figure, name: str) -> None:
    (ROOT / "docs" / "images" / f"{name}.svg").write_text(svg_of(canvas, name), encoding="utf-8")


if __name__ == "__main__":
    main()
