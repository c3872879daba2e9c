"""Kernels that are linked: the same from Python and from kernels, with numba's cache for what Python calls."""

import subprocess
import sys

import pytest

from diffcloud.compiled import UNCOMPILED

pytestmark = pytest.mark.skipif(UNCOMPILED, reason="kernels run uncompiled")

MODULE = '''
from collections import namedtuple
import numpy as np
from diffcloud.compiled import kernel

Pair = namedtuple("Pair", ["values", "factor"])

@kernel
def scaled(pair, power=1.0):
    """What it says."""
    return pair.values * pair.factor**power

@kernel
def total(pair):
    found = 0.0
    for value in scaled(pair, 2.0):
        found += value
    return found

@kernel
def factorial(n):
    if n < 2:
        return 1
    return n * factorial(n - 1)

@kernel
def refuse(n):
    if n > 1:
        raise ValueError("too many")
    return n
'''

USE = """
import numpy as np
from own import *
pair = Pair(np.arange(4.0), 3.0)
assert np.array_equal(scaled(pair), [0.0, 3.0, 6.0, 9.0])
assert np.array_equal(scaled(pair, power=2.0), [0.0, 9.0, 18.0, 27.0])
assert total(pair) == 54.0
assert factorial(5) == 120
try:
    refuse(2)
except ValueError as error:
    assert str(error) == "too many"
assert scaled.__doc__ == "What it says."
"""


def test_kernels_run_from_python_and_from_kernels_and_are_kept(tmp_path):
    (tmp_path / "own.py").write_text(MODULE)
    environment = {"DIFFCLOUD_CACHE_DIR": str(tmp_path / "kept"), "PYTHONPATH": str(tmp_path), "PATH": ""}
    for _ in range(2):  # compiled, then from the cache
        done = subprocess.run([sys.executable, "-c", USE], env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        kept = {path.name.split(".")[1].split("-")[0] for path in (tmp_path / "kept").rglob("*.nbi")}
        assert kept == {"scaled", "total", "factorial", "refuse"}
