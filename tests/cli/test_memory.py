"""The allocator keeps freed memory: most large blocks cost no new pages."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

from tests.cli.invoke import ROOT

_FAULTS = """
import ctypes, resource, sys
if sys.argv[1] == "kept":
    from diffcloud.jobs.memory import keep_freed_memory
    assert keep_freed_memory()
libc = ctypes.CDLL(None)
libc.malloc.restype = ctypes.c_void_p
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    block = libc.malloc(ctypes.c_size_t(40_000_000))  # glibc by itself keeps no block above 32 MB
    ctypes.memset(block, 1, 40_000_000)
    libc.free(ctypes.c_void_p(block))
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library")
def test_a_freed_block_is_used_again():
    faults = {
        how: int(subprocess.run([sys.executable, "-c", _FAULTS, how], cwd=ROOT, capture_output=True, check=True).stdout)
        for how in ("kept", "returned")
    }
    assert faults["kept"] < faults["returned"] / 10
