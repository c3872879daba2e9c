"""The moving picture of README: the towel of examples/, as recorded and as fitted, from two sides (`make pictures`)."""

from __future__ import annotations

import io
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from diffcloud.estimation.result import FittedMotion, read_motion
from diffcloud.io.episodes import Episode, read_episode
from diffcloud.reporting.overlay import states_at

ROOT = Path(__file__).parents[2]
RECORDING, FIT = ROOT / "examples" / "towel.npz", ROOT / "build" / "towel" / "fit.npz"
SIDES = (-60, 30)
"""Azimuth of each view [deg]."""
RECORDED, CLOTH, EDGE, HELD = "#333333", "#2a9d8f", "#14524b", "#b3261e"
SIZE = (6.4, 2.9)
"""[inch], at 100 dots per inch."""
EVERY = 2
"""One of so many recorded points is drawn."""
FRAME_MS, LAST_MS = 110, 1000
"""How long each frame is shown [ms]; the last one longer, before the motion begins again."""
COLOURS = 48
"""Of the GIF; with more it is larger than a page should load."""


def main() -> None:
    episode, motion = read_episode(RECORDING), read_motion(FIT)
    frames = [picture(episode, motion, frame) for frame in range(episode.frame_count)]
    first, *others = (one.quantize(COLOURS, method=Image.Quantize.MAXCOVERAGE) for one in frames)
    durations = [FRAME_MS] * len(others) + [LAST_MS]
    file = ROOT / "docs" / "images" / "fit.gif"
    first.save(file, save_all=True, append_images=others, duration=durations, loop=0, optimize=True)


def picture(episode: Episode, motion: FittedMotion, frame: int) -> Image.Image:
    """Draw one frame of the recording with its fit, from each side."""
    figure = Figure(figsize=SIZE, dpi=100)
    (state,) = states_at(motion.times, episode.times[[frame]])
    nodes, cloud = motion.nodes[state], episode.frame(frame)[::EVERY]
    for place, side in enumerate(SIDES, 1):
        axes = figure.add_subplot(1, len(SIDES), place, projection="3d", computed_zorder=False)
        options = {"color": CLOTH, "alpha": 0.7, "linewidth": 0.25, "edgecolor": EDGE}
        axes.plot_trisurf(*nodes.T, triangles=motion.faces, zorder=1, **options)
        axes.scatter(*cloud.T, s=1.2, color=RECORDED, alpha=0.55, zorder=2)
        axes.scatter(*nodes[motion.held].T, s=14, color=HELD, alpha=1, depthshade=False, zorder=3)
        low, high = motion.nodes.min(axis=(0, 1)), motion.nodes.max(axis=(0, 1))
        middle, half = (low + high) / 2, (high - low).max() / 2
        axes.set(**{f"{axis}lim": (mid - half, mid + half) for axis, mid in zip("xyz", middle, strict=True)})
        axes.set_axis_off()
        axes.view_init(18, side)
        axes.set_box_aspect((1, 1, 1), zoom=1.7)
    time = f"{episode.times[frame]:.1f} s"
    legend = ("dots: recorded cloud", "surface: fitted simulation", "red: held nodes")
    figure.text(0.5, 0.03, "   ·   ".join((time, *legend)), ha="center", fontsize=8.5)
    figure.subplots_adjust(0, 0.02, 1, 1, 0, 0)
    drawn = io.BytesIO()
    FigureCanvasAgg(figure).print_png(drawn)
    return Image.open(drawn).convert("RGB")


if __name__ == "__main__":
    main()
