"""Pages of studies whose own tests have no page, from made-up measurements."""

from __future__ import annotations

import numpy as np

from diffcloud.scene.scenarios import load_scenario
from studies import acceptance, discretisation, towels
from studies.convergence import MeshRow, StepRow
from studies.mujoco_towels import OLD, PAD, Apart, towel
from tests.docs.form import check_form
from tests.robustness.page import page as robustness


def test_discretisation_has_the_default_steps_first():
    scene = load_scenario("lift").scene
    steps = [
        StepRow("lift", "implicit", 2, count, np.full(9, 0.01 / count), np.full(9, 1e-9), np.full(9, 1e-3), 0.05)
        for count in (2, scene.frame_steps)
    ]
    page = discretisation._page({"lift": scene}, steps, [MeshRow("lift", 0, 49, np.full(9, 0.02), 0.1)])
    assert "the largest distance to 4 times the steps is 1.2 mm (lift)." in page
    assert page.count(f"| lift | implicit, BDF2 | {scene.frame_steps} (default) | 1.2 |") == 2
    assert "| lift | 50 (8) | none | none |" in page
    assert "| lift | 49 | 20.0 | 20.0 | 100 |" in page
    check_form(page)


def test_towels_compare_the_pad_with_a_single_node():
    rows = [
        Apart(towel(seed), model, nodes, np.linspace(0, 1.5, 16) * far, 0.5)
        for seed in (1, 2)
        for model, far in ((OLD, 0.010), (PAD, 0.002))
        for nodes in ((13, 10), (19, 15))
    ]
    page = towels._page(rows, 1, 2)
    assert "the nodes of 2 towels are 2.0 mm from MuJoCo's after 1 s" in page
    assert "With a single held node they are 10.0 mm away." in page
    assert f"| {PAD} | 19 × 15 | 1.0 | 1.6 | 2.0 | 2.4 | 3.0 | 2 of 2 | 0.5 |" in page
    check_form(page)


def test_fits_of_the_published_clouds_are_held_against_the_best_predictor():
    values = {"stretching": 1.0, "density": 2.0}
    fits = [
        acceptance._Fit(name, 0.02, 0.009, values, 2.0, many, values, {"mlp": 0.01, "meteornet": other})
        for name, many, other in (("lift_tan", 0.005, 0.02), ("lift_tan2", 0.007, 0.004), ("fold_tan", 0.0101, 0.03))
    ]
    page = acceptance._fit_report(fits, 9)
    assert (
        "has a mean loss of 0.00600 (lifts) and 0.01010 (folds), the best published predictor 0.01000 and 0.01000" in page
    )
    assert "within 2 %, in 2 of 3 recordings." in page
    assert "| lift | 2 | 0.02000 | 0.00900 | 0.00600 | 0.01000 |" in page
    check_form(page)


def test_timings_are_of_one_motion_and_of_batches():
    timings = [
        {"scenario": name, "nodes": nodes, "steps": 25, "batch": batch, "forward": 0.001 * nodes, "forward_backward": 1.0}
        | {"forward_tangents": 2.0}
        for name, nodes, batch in (
            ("lift", 49, 1), ("lift", 49, 16), ("release_lift", 49, 1), ("a", 256, 1), ("b", 1024, 1), ("c", 4096, 1),
        )
    ]  # fmt: skip
    contact = {"nodes": 100, "contacts": 60.0, "steps": 25, "free": 0.1, "touching": 0.2, "per_contact": 6e-5}
    page = acceptance._speed(timings, [{"frames": 25, "points": 200, "first": 0.006, "again": 0.004}], [contact])
    assert "A built-in `lift` takes 49.0 ms of one core, 1000.0 ms with its gradient, and 2000.0 ms" in page
    assert "to the power 1.00 from 256 to 1,024 nodes, and 1.00 from there" in page
    assert page.index("| lift | 49 | 25 | 1 |") < page.index("<summary>Batches") < page.index("| lift | 49 | 25 | 16 |")
    check_form(page)


def test_robustness_counts_what_ended_as_required():
    damage = {"suite": "inputs", "of": "scene", "where": "points", "what": "huge", "verdict": "refused", "seconds": 1.0}
    told = [
        {**damage, "wrong": None, "told": "Error: points: too many."},
        {**damage, "wrong": "taken, though it must be refused", "told": ""},
        {"suite": "faults", "of": "fit", "what": "kill", "wrong": None},
        {"suite": "arm", "where": "the link is cut", "what": "Stop", "late_ms": 2.0, "wrong": None, "detected_s": 0.02}
        | {"frames": 3, "rows": 4, "told": "lost"},
    ]
    page = robustness(told, 2)
    assert "1 of 2 damaged files, 1 of 1 disturbed commands, 1 of 1 faults of a moving arm ended as required." in page
    assert "| scene | 2 | 2 | 0 |" in page
    assert "at most 2 of each file" in page
    assert "<summary>Disturbed commands" not in robustness(told[:2], None)
    check_form(page)
    check_form(robustness(told[:2], None))
