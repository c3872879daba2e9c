"""Straight code computes what Python does with the same text, and refuses what it does not know."""

from math import atan2, cos, floor, log, sin, sqrt
from typing import NamedTuple

import numba
import numpy as np
import pytest

from diffcloud.compiled import UNCOMPILED
from diffcloud.sim.compiled.straight import straight

pytestmark = pytest.mark.skipif(UNCOMPILED, reason="kernels run uncompiled")


class Given(NamedTuple):
    table: np.ndarray
    """[N, 4, 2]"""
    rows: np.ndarray
    """[N]"""
    size: float


def every_form(given, outputs):
    for e in range(len(given.rows)):
        i = given.rows[e]
        a = given.table[i, 0, 1]
        b = given.table[e, 1, 0]
        low = a < b
        also = b <= 2.0
        t0 = -a if low & also else given.size
        t1 = sqrt(a * a + 1.5)
        t2 = log(t1) / t1 - sin(b)
        t3 = atan2(cos(a), abs(b)) + min(a, b)
        t4 = floor(3.0 * t1)
        t5 = given.table[i, int(t4 * 0.0 + 2.0), 0]
        t6 = (1.0 if a > 0 else 0.0) - (1.0 if a < 0 else 0.0)
        same = b == b
        t7 = t4 if same else t0
        outputs[e, 0] = t0
        outputs[e, 0] += t2
        for c in range(4):
            column = c // 2
            place = c % 2
            t8 = t3 if c == 2 else t5
            outputs[e, 1 + column] += t8
            outputs[e, 3 + place] += t6 * t7


compiled_form = straight(every_form)


@numba.njit(error_model="numpy")
def run_compiled(given, outputs):
    compiled_form(given, outputs)


def test_every_form_gives_the_same_bits_as_python():
    random = np.random.default_rng(3)
    given = Given(random.normal(size=(40, 4, 2)), random.permutation(40), 0.25)
    expected, found = np.zeros((40, 6)), np.zeros((40, 6))
    every_form(given, expected)
    run_compiled(given, found)
    assert np.array_equal(found, expected)
    assert np.abs(expected[:, :5]).min(axis=0).max() > 0  # each output was written


def while_loop(outputs):
    while outputs[0] < 1:
        outputs[0] += 1.0


def power(outputs):
    outputs[0] = outputs[0] ** 2.0


def other_function(outputs):
    outputs[0] = round(outputs[0])


def text(outputs):
    outputs[0] = "one"


@pytest.mark.parametrize("function", [while_loop, power, other_function, text])
def test_other_code_is_refused_with_its_text(function):
    refused = straight(function)

    @numba.njit
    def run(outputs):
        refused(outputs)

    with pytest.raises(Exception, match="Straight code has no"):
        run(np.zeros(1))
