"""A report of one made-up episode."""

from __future__ import annotations

import json
import re

import numpy as np

from diffcloud.estimation.result import FittedMotion
from diffcloud.io.episodes import Episode
from diffcloud.mesh.topology import SurfaceMesh
from diffcloud.reporting.page import EpisodeEntry, Summary, build_page
from diffcloud.reporting.uncertainty import NamedFit, parameters_table
from tests.estimation.records import record_of, recording_of

_TRIANGLE = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]] * 2)


def entry(name="tan1", *, scenario="lift", fabric="tan", failures=()):
    nuisance = {
        "x": {"value": 0.21, "prior": 0.1, "unit": "m"},
        "yaw": {"value": 0.1, "prior": 0.5, "unit": "rad"},
    }
    fit = record_of(recording_of(name, scenario=scenario, nuisance=nuisance), failures=list(failures))
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
        recording=fit.episodes[0],
        episode=recorded,
        motion=FittedMotion(
            nodes=_TRIANGLE,
            start_nodes=_TRIANGLE,
            faces=np.array([[0, 1, 2]]),
            times=np.array([0.0, 0.1]),
            bodies=SurfaceMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)),
            held=np.array([0]),
            held_times=np.array([0.0, 0.1]),
            held_nodes=_TRIANGLE[:, :1],
        ),
    )


SUMMARY = Summary(
    status="Fits to the noise",
    good=True,
    residual="residual 10.0 mm RMS",
    parameters=parameters_table([NamedFit("fit", entry().fit, None)]),
    findings=["The simulation follows tan1."],
    held_out="Not tested.",
    next_steps=["Fit a second recording."],
)


def page_of(*entries, title="Report", **more):
    return build_page(entries or [entry()], title=title, cloud_points=4, environment={"torch": "2"}, **more)


def overlays_of(page):
    """What the page's script draws in three dimensions."""
    return json.loads(re.search(r"const overlays = (.*);", page).group(1))


def main_of(page):
    """What a reader sees, without the scripts, in one line."""
    return " ".join(page[page.index("<main>") : page.index("</main>") + len("</main>")].split())
