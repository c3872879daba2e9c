"""A report of one made-up episode."""

from __future__ import annotations

import numpy as np

from diffcloud.io.episodes import Episode
from diffcloud.mesh.topology import SurfaceMesh
from diffcloud.report import EpisodeEntry, build_page

_TRIANGLE = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]] * 2)


def entry(name="tan1", *, scenario="lift", fabric="tan", failures=()):
    fit = {
        "parameters": {"stretch": {"value": 1.5, "physical": 60.0, "physical_unit": "N/m"}},
        "history": {"loss": [[0.2], [0.1]]},
        "episodes": [name],
        "recordings": {
            name: {
                "rms_mm": 10.0,
                "rms_to_recording_mm": 12.0,
                "rms_to_cloth_mm": 7.5,
                "frames": [1],
                "frame_rms_mm": [10.0],
                "counted": [0.8],
                "cut_m": None,
                "nuisance": {
                    "x": {"value": 0.21, "prior": 0.1, "unit": "m"},
                    "yaw": {"value": 0.1, "prior": 0.5, "unit": "rad"},
                },
            }
        },
        "iterations": 2,
        "seconds": 1.5,
        "failures": list(failures),
    }
    row = {
        "rms_start_mm": 20.0,
        "rms_mm": 10.0,
        "rms_other_frames_mm": float("nan"),
        "fitted_ratio": 2.0,
        "true_ratio": 2.2,
    }
    recorded = Episode.from_frames([np.zeros((4, 3)), np.ones((4, 3))], np.array([0.0, 0.1]), meta={"fabric": fabric})
    return EpisodeEntry(
        scenario=scenario,
        name=name,
        row=row,
        fit=fit,
        episode=recorded,
        nodes=_TRIANGLE,
        start_nodes=_TRIANGLE,
        faces=np.array([[0, 1, 2]]),
        times=np.array([0.0, 0.1]),
        bodies=SurfaceMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)),
    )


def page_of(*entries, comparison=None, title="Report"):
    return build_page(
        entries or [entry()], title=title, overlay_points=4, environment={"torch": "2"}, comparison=comparison
    )


def main_of(page):
    """What a reader sees, without the scripts, in one line."""
    return " ".join(page[page.index("<main>") : page.index("</main>") + len("</main>")].split())
