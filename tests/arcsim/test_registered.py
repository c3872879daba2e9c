"""What `sim` and `scene` name of this package is there."""

from __future__ import annotations

from importlib import import_module

import pytest

from diffcloud.arcsim.release import RELEASE
from diffcloud.errors import SceneError
from diffcloud.scene import load_scene
from diffcloud.scene.registry import EXPERIMENTS, READERS


def test_the_published_experiments_are_registered():
    assert tuple(EXPERIMENTS) == tuple(RELEASE)
    for place in EXPERIMENTS.values():
        assert callable(import_module(place).load_experiment)


def test_readers_of_scene_files_are_registered(tmp_path):
    for place in READERS.values():
        assert callable(import_module(place).load_scene)
    with pytest.raises(SceneError, match=r"sheet.usd: Unknown kind of scene file '.usd'. Allowed: .json"):
        load_scene(tmp_path / "sheet.usd")
