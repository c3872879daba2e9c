"""Compile functions (kernels) with numba, and cache the machine code.

numba compiles a kernel on its first call and stores the machine code in the user's cache folder. The subfolder is named
after a fingerprint of all kernel sources. numba itself checks only a function's own file, not the functions that it
calls. So an upgrade compiles again and never mixes versions, and all installations of one version share the code. Several
processes may compile at once, since files are written atomically. When a new subfolder is created, those of other
versions that were unused for 30 days are removed.

`DIFFCLOUD_CACHE_DIR` sets the cache folder. `DIFFCLOUD_UNCOMPILED=1` runs all kernels as plain Python, for a debugger.
A step then takes seconds.
"""

from __future__ import annotations

import gc
import hashlib
import logging
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import llvmlite  # type: ignore[import-untyped]
import numba
from numba.core import event
from platformdirs import user_cache_path

from diffcloud.errors import DiffCloudError
from diffcloud.linked import LinkedKernel

UNCOMPILED = os.environ.get("DIFFCLOUD_UNCOMPILED", "") not in ("", "0")
_PACKAGE = Path(__file__).parent
_KEPT_DAYS = 30
_OPTIONS: Any = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
_MARK = "complete"
"""Name of a file in the cache folder that exists once all kernels have been compiled in advance."""
_PATIENT = (100_000, 50, 100)
"""Thresholds of the garbage collector during compilation. Without a collector, memory usage would double."""
_log = logging.getLogger(__name__)

F = TypeVar("F", bound=Callable[..., Any])


def kernel_sources(package: Path = _PACKAGE) -> Iterator[Path]:
    """Yield the files that contain kernels, or from which kernels are generated."""
    for source in sorted(package.rglob("*.py")):
        text = b"\n" + source.read_bytes()
        if b"\n@kernel\n" in text or b"sim.compiled" in text or source.parent == package / "sim" / "compiled":
            yield source


def fingerprint(package: Path = _PACKAGE) -> str:
    """Hash (16 hexadecimal digits) of the compiler versions, the compiler driver, and the kernel sources."""
    digest = hashlib.sha256(f"{numba.__version__} {llvmlite.__version__}".encode())
    for driver in ("compiled.py", "linked.py"):
        digest.update((_PACKAGE / driver).read_bytes())
    for source in kernel_sources(package):
        digest.update(source.relative_to(package).as_posix().encode())
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


@cache
def cache_folder() -> Path:
    """Return the folder for compiled and generated code of this version. It is created if possible."""
    root = Path(os.environ["DIFFCLOUD_CACHE_DIR"]) if "DIFFCLOUD_CACHE_DIR" in os.environ else user_cache_path("diffcloud")
    folder = root / "kernels" / fingerprint()
    with suppress(OSError):  # numba reports a cache that is not writable
        if not folder.is_dir():
            folder.mkdir(parents=True)
            remove_stale(folder)
        os.utime(folder)  # record the time of use
    return folder


def remove_stale(folder: Path) -> None:
    """Remove sibling folders of other versions that were unused for 30 days."""
    for other in folder.parent.iterdir():
        if other == folder or not re.fullmatch("[0-9a-f]{16}", other.name):
            continue
        with suppress(OSError):  # another process may be removing it too
            if time.time() - other.stat().st_mtime > _KEPT_DAYS * 86400:
                shutil.rmtree(other, ignore_errors=True)


def cache_size() -> int:
    """Return the size of all files in the cache folder [bytes]."""
    return sum(file.stat().st_size for file in cache_folder().rglob("*") if file.is_file())


def is_built() -> bool:
    """Whether all kernels have been compiled in advance."""
    return (cache_folder() / _MARK).is_file()


def mark_built() -> None:
    """Record that all kernels have been compiled in advance."""
    cache_folder().mkdir(parents=True, exist_ok=True)
    (cache_folder() / _MARK).touch()


def kernel(function: F) -> F:
    """Compile a function with numba. Arguments are arrays, numbers, and named tuples of them. It releases the GIL."""
    if UNCOMPILED:
        return function
    config: Any = numba.config
    given, config.CACHE_DIR = config.CACHE_DIR, str(cache_folder())  # set our cache folder for this function only
    try:
        return cast(F, LinkedKernel(function, **_OPTIONS))
    finally:
        config.CACHE_DIR = given


Work = Sequence[tuple[str, str]]
"""Names, and functions as "module:function" that call each kernel once with arguments of all used types."""


def compile_all(progress: Callable[[int, str], None], work: Sequence[Work]) -> None:
    """Compile everything that is not in the cache folder, and record that it is complete.

    Args:
        progress: called with the number of finished pieces of work and the name of an unfinished one.
        work: pieces of work. Each list runs sequentially in its own process, all lists in parallel.

    Raises:
        DiffCloudError: a piece failed.
    """
    left = [name for pieces in work for name, _ in pieces]
    count = len(left)
    progress(0, left[0])

    def done(name: str) -> None:
        left.remove(name)
        progress(count - len(left), left[0] if left else "")

    with ThreadPoolExecutor(len(work)) as pool:
        for job in as_completed([pool.submit(_run, pieces, done) for pieces in work]):
            job.result()
    mark_built()


def _run(pieces: Work, done: Callable[[str], None]) -> None:
    code = "from diffcloud.compiled import announcement; announcement.silent = True; import importlib\n" + "".join(
        f"importlib.import_module({module!r}).{function}(); print(flush=True)\n"
        for module, function in (place.split(":") for _, place in pieces)
    )
    # Colouring error messages, of which numba creates thousands that are never shown, would take 5 % of the time.
    plain = os.environ | {"NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING": "1"}
    command = [sys.executable, "-c", code]
    with (
        tempfile.TemporaryFile("w+") as errors,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True, env=plain) as process,
    ):
        assert process.stdout is not None
        left = iter(pieces)
        for _ in process.stdout:
            done(next(left)[0])
        if process.wait() != 0:
            errors.seek(0)
            raise DiffCloudError(f"Compiling {next(left)[0]} failed: {errors.read().strip().splitlines()[-1:]}")


class _Announcement(event.Listener):
    """Logs once per process that kernels are being compiled, and reduces garbage collection meanwhile.

    With the default thresholds, garbage collection takes a fifth of the compilation time.
    """

    def __init__(self) -> None:
        self.silent = False
        self._depth = 0
        self._thresholds = gc.get_threshold()

    def on_start(self, compiling: Any) -> None:
        if self._depth == 0:
            self._thresholds = gc.get_threshold()
            gc.set_threshold(*_PATIENT)
        self._depth += 1
        function = compiling.data["dispatcher"].py_func
        if not self.silent and (function.__module__ or "").startswith("diffcloud"):
            self.silent = True
            _log.warning(
                "Compiling kernels, once for this version and computer (up to five minutes); kept in %s.", cache_folder()
            )

    def on_end(self, compiling: Any) -> None:
        self._depth -= 1
        if self._depth == 0:
            gc.set_threshold(*self._thresholds)


announcement = _Announcement()
event.register("numba:compile", announcement)
