"""Where compiled code is kept, when it is made anew, and `diffcloud doctor --compile`."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time

import pytest

from diffcloud import compiled
from diffcloud.compiled import compile_all
from diffcloud.errors import DiffCloudError
from tests.cli.invoke import DIFFCLOUD, ROOT

DAY = 86400


@pytest.fixture
def run(tmp_path):
    """Run a program with a cache folder of its own."""

    def started(*command, root=ROOT):
        env = {**os.environ, "PYTHONPATH": str(root), "DIFFCLOUD_CACHE_DIR": str(tmp_path / "cache")}
        env.pop("DIFFCLOUD_UNCOMPILED", None)
        done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=600)
        assert done.returncode == 0, done.stderr
        return done

    return started


@pytest.mark.slow  # starts a process for each kind of kernel
def test_doctor_compiles_what_is_missing(run, tmp_path):
    """In a cache without a part of the nearest neighbours. Where the tests have not run before, everything is compiled."""

    def doctor(*options):
        done = run(*DIFFCLOUD, "doctor", "--json", *options)
        assert "Compiling" not in done.stderr
        return json.loads(done.stdout.strip().splitlines()[-1])["compiled"]

    own = tmp_path / "cache" / "kernels" / compiled.cache_folder().name
    half_written = shutil.ignore_patterns("complete", "*.tmp*", "curve.*")
    shutil.copytree(compiled.cache_folder(), own, ignore=half_written)
    before = doctor()
    assert before["folder"] == str(own)
    assert not before["built"]
    after = doctor("--compile")
    assert after["folder"] == before["folder"]
    assert after["built"]
    assert after["bytes"] > before["bytes"]
    assert list(own.rglob("curve.*.nbc"))
    assert doctor() == after


def test_first_use_says_once_that_it_compiles_for_all_installations_of_a_version(run, tmp_path):
    shutil.copytree(ROOT / "diffcloud", tmp_path / "other" / "diffcloud", ignore=shutil.ignore_patterns("__pycache__"))
    use = "from diffcloud.clouds import neighbours as n; n.compile_neighbours(); print(n.__file__)"
    assert run(sys.executable, "-c", use).stderr.count("Compiling kernels") == 1
    done = run(sys.executable, "-c", use, root=tmp_path / "other")
    assert str(tmp_path / "other") in done.stdout
    assert done.stderr == ""


def test_compile_all_tells_its_progress(monkeypatch, tmp_path):
    monkeypatch.setattr(compiled, "cache_folder", lambda: tmp_path / "made")
    told = []
    assert not compiled.is_built()
    compile_all(lambda *now: told.append(now), [[("a", "gc:collect"), ("b", "gc:enable")]])
    assert told == [(0, "a"), (1, "b"), (2, "")]
    assert compiled.is_built()


def test_what_fails_to_compile_is_named_and_not_marked(monkeypatch, tmp_path):
    monkeypatch.setattr(compiled, "cache_folder", lambda: tmp_path / "made")
    with pytest.raises(DiffCloudError, match=r"Compiling b failed.*has no attribute"):
        compile_all(lambda *now: None, [[("a", "gc:collect"), ("b", "gc:nothing")]])
    assert not compiled.is_built()


def test_old_folders_of_other_versions_go(tmp_path):
    names = {"0" * 16: 0, "1" * 16: 31, "2" * 16: 29, "notes": 400}
    for name, days in names.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "kernel.nbc").touch()
        os.utime(tmp_path / name, (time.time() - days * DAY,) * 2)
    compiled.remove_stale(tmp_path / ("0" * 16))
    assert {path.name for path in tmp_path.iterdir()} == set(names) - {"1" * 16}


def test_the_fingerprint_follows_kernels_and_the_simulator_alone(tmp_path):
    package = tmp_path / "package"
    for name in ("sim/compiled/trace.py", "clouds/tree.py", "clouds/losses.py"):
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / "diffcloud" / "errors.py", package / name)
    (package / "clouds" / "tree.py").write_text("@kernel\ndef f(): ...\n\n@kernel\ndef g(): ...\n")
    first = compiled.fingerprint(package)
    for name, changes in (("clouds/losses.py", False), ("clouds/tree.py", True), ("sim/compiled/trace.py", True)):
        before = compiled.fingerprint(package)
        with (package / name).open("a") as file:
            file.write("# more\n")
        assert (compiled.fingerprint(package) != before) == changes
    assert compiled.fingerprint(package) != first
    sources = {path.name for path in compiled.kernel_sources()}
    assert {"tree.py", "curve.py"} <= sources
    assert "losses.py" not in sources


def test_the_fingerprint_follows_what_kernels_are_given():
    """Fields of one type could change places, and machine code that is kept would read the wrong ones."""
    given = {path for path in (ROOT / "diffcloud").rglob("*.py") if "(NamedTuple)" in path.read_text()}
    assert len(given) > 10
    assert given <= set(compiled.kernel_sources())
