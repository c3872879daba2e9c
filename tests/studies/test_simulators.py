"""The page of `python -m studies simulators`, from made-up rows: the study itself needs other simulators, and minutes."""

from __future__ import annotations

import numpy as np

from studies.simulator_motions import THIS, WHOLE_STIFFNESS, Answer, Derivative, Pair
from studies.simulators import _page
from tests.docs.form import check_form


def pair(problem, what, against, millimetres=1.0):
    times = np.arange(51 if problem != "swing" else 31) / 20
    return Pair(problem, what, against, times, np.full(len(times), 1e-3 * millimetres), 0.5)


def test_the_page_holds_every_row():
    page = _page(
        {"diffcloud": "1", "mujoco": "2", "newton": "3", "warp-lang": "4"},
        [Answer("strip", name, {"elongation": 0.0102}, {"elongation": 0.01}) for name in (THIS, "MuJoCo")],
        [
            pair("lift", "MuJoCo, 0.2 ms", THIS, 2.0),
            pair("lift", "MuJoCo, 0.1 ms", THIS, 3.5),
            pair("fold", "MuJoCo, 0.2 ms", THIS),
            pair("swing", "MuJoCo, 0.2 ms", "MuJoCo, 0.1 ms", 8.0),
        ],
        [pair("swing", WHOLE_STIFFNESS, THIS, 41.9), pair("swing", WHOLE_STIFFNESS, "MuJoCo", 0.2)],
        [pair("lift", "nothing", THIS, 3.0), pair("swing", "nothing", THIS, 4.0), pair("lift", "friction", THIS, 5.0)],
        [Derivative(THIS, 0.015, 0.0151, 0.1, 0.2)],
    )
    assert "mujoco 2, newton 3" in page
    assert "are within 2.0 % of theory. A lifted towel stays within 3.5 mm of MuJoCo's." in page
    assert "| lift | 3.5 | – | – | – |" in page
    assert "| strip | MuJoCo | elongation | 0.01 | 0.0102 | +2.0 % |" in page
    assert "| MuJoCo, 0.2 ms | this simulator | 2.0 | 2.0 | 2.0 | 2.0 | 2.0 | 2.0 | 0.50 |" in page
    assert "| nothing | 3.0 | 3.0 | 3.0 | 4.0 | 4.0 | 4.0 |" in page
    assert "| friction | 5.0 | 5.0 | 5.0 | – | – | – |" in page
    assert "half a second into the swing this towel would be 41.9 mm from where it is" in page
    assert "MuJoCo comes to be 8.0 mm from itself" in page
    assert "| this simulator | 15.000 | 15.100 | 0.10 | 0.20 |" in page
    check_form(page)
