"""The package as it is installed from its wheel, away from this checkout."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest
import yaml

from diffcloud.io.episodes import write_episode
from diffcloud.scene.scenarios import load_scenario
from tests.cli.invoke import ROOT
from tests.cli.test_likelihood import SCENARIO
from tests.estimation.test_fit import clouds_of

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """The Python of an environment that has the wheel, and this environment's other packages."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    shutil.copytree(ROOT / "diffcloud", source / "diffcloud", ignore=shutil.ignore_patterns("__pycache__"))
    command = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--quiet", "-w", folder, source]
    subprocess.run(command, check=True, timeout=300)
    (wheel,) = folder.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names if ".dist-info/" not in name} == {"diffcloud"}
    venv.create(folder / "venv", with_pip=False)
    python = folder / "venv" / "bin" / "python"
    (own,) = (folder / "venv" / "lib").glob("python*/site-packages")
    # a path file adds packages, and not the path files among them: this checkout is not importable
    (own / "others.pth").write_text(sysconfig.get_path("purelib"))
    command = [sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--no-index", "--quiet", wheel]
    subprocess.run(command, check=True, timeout=300)
    return python


def run(python: Path, folder: Path, *words: str) -> str:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run([python, *words], cwd=folder, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_it_is_the_installed_one(installed, tmp_path):
    told = run(installed, tmp_path, "-c", "import diffcloud; print(diffcloud.__file__)")
    assert not Path(told.strip()).is_relative_to(ROOT)
    assert "site-packages" in told


def test_it_checks_itself_and_fits(installed, tmp_path):
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(SCENARIO))
    write_episode(
        tmp_path / "e1.npz", clouds_of(load_scenario(tmp_path / "small.yaml"), points=2000, stretching=0.7, density=1.0)
    )
    assert json.loads(run(installed, tmp_path, "-m", "diffcloud", "doctor", "--json").splitlines()[-1])
    options = ["--scene", "small.yaml", "--parameters", "stretching", "--fix", "density=0.2", "--starts", "1"]
    told = json.loads(
        run(installed, tmp_path, "-m", "diffcloud", "fit", *options, "--out", "fits", "e1.npz", "--json").splitlines()[-1]
    )
    assert 1.2 < told["parameters"]["stretching"]["value"] < 6
    assert (tmp_path / "fits" / "fit.json").is_file()
