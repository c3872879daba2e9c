"""rig.yaml: what it says is what the capture keeps."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from diffcloud.errors import ConfigError
from diffcloud.hardware import ArmLimits, Limits
from diffcloud.hardware.camera_settings import CameraSettings
from diffcloud.hardware.rig import BoardSettings, RigSettings, read_rig
from diffcloud.sensing.calibration.charuco import CharucoBoard
from tests.docs.examples import PAGES, examples, read
from tests.docs.site import reference
from tests.hardware.rig_files import write_rig


def test_an_empty_file_has_the_limits_of_the_library(tmp_path):
    (tmp_path / "rig.yaml").write_text("")
    rig = read_rig(tmp_path / "rig.yaml")
    assert rig == RigSettings()
    assert (rig.limits(), rig.arm_limits()) == (Limits(), ArmLimits())
    assert rig.camera_settings("side") == CameraSettings()
    assert rig.board.charuco() == CharucoBoard()


def test_each_limit_arrives(tmp_path):
    path = write_rig(
        tmp_path, workspace_m=[[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]], speed_m_s=0.07, acceleration_m_s2=0.8, force_n=9,
        torque_nm=4, static_force_n=6, table_height_m=-0.02, link_margin_m=0.03,
    )  # fmt: skip
    rig = read_rig(path)
    changed = Limits((0.1, 0.2, 0.3), (0.4, 0.5, 0.6), 0.07, 0.8, 9, 4, preload_N=6, preload_Nm=2)
    assert rig.limits() == changed
    assert rig.arm_limits() == ArmLimits(table_m=-0.02, margin_m=0.03)


@pytest.mark.parametrize(
    "name", ["speed_m_s", "acceleration_m_s2", "force_n", "torque_nm", "static_force_n", "link_margin_m", "time_scale"]
)
@pytest.mark.parametrize("value", [0, -1, float("nan"), float("inf"), 1e6, True, "fast", None])
def test_no_limit_can_be_switched_off(tmp_path, name, value):
    with pytest.raises(ConfigError, match=rf"rig\.yaml: {name}: "):
        read_rig(write_rig(tmp_path, **{name: value}))


def test_cameras_are_set_alike_but_for_the_master(tmp_path):
    path = write_rig(
        tmp_path, cameras={"top": "1", "side": "2"}, master="top", preset="high_accuracy", laser_power_mw=0,
        auto_exposure=True,
    )  # fmt: skip
    rig = read_rig(path)
    assert rig.camera_settings("top") == CameraSettings(False, "high_accuracy", 0.0, "master")
    assert rig.camera_settings("side") == CameraSettings(False, "high_accuracy", 0.0, "slave")


@pytest.mark.parametrize("written", ["036522070001", "'036522070001'", "817512070123", "CL8F25300"])
def test_serial_numbers_keep_their_digits_without_quotes(tmp_path, written):
    (tmp_path / "rig.yaml").write_text(f"cameras: {{side: {written}}}\n")
    assert read_rig(tmp_path / "rig.yaml").cameras == {"side": written.strip("'")}


def test_a_serial_number_that_yaml_reads_as_another_number_is_refused(tmp_path):
    (tmp_path / "rig.yaml").write_text("cameras: {side: 1e5}\n")
    with pytest.raises(ConfigError, match=r"rig\.yaml: cameras\.side: Input should be a valid string"):
        read_rig(tmp_path / "rig.yaml")


def test_paths_are_relative_to_the_file(tmp_path, monkeypatch):
    path = write_rig(tmp_path, calibration="raw/lab.json", urdf="/robots/arm.urdf")
    monkeypatch.chdir("/")
    rig = read_rig(path)
    assert (rig.calibration, rig.urdf) == (tmp_path / "raw/lab.json", Path("/robots/arm.urdf"))


def test_every_setting_is_described_on_the_page_of_settings():
    for section in (RigSettings, BoardSettings):
        described = reference.attribute_docs(section)
        assert set(section.model_fields) - set(described) <= {"board"}
        for meaning in described.values():
            assert reference._escaped(meaning) in " ".join(reference.settings_page().split())


def test_the_file_on_the_page_states_all_settings_and_their_defaults(tmp_path):
    """A reader copies it. What it sets beside the defaults is what every lab has to set."""
    example = next(one for one in examples(read("docs/capture.md")) if one.words == ("rig.yaml",))
    (tmp_path / "rig.yaml").write_text(example.text)
    stated = yaml.safe_load(example.text)
    assert set(stated) == set(RigSettings.model_fields)
    rig = read_rig(tmp_path / "rig.yaml")
    different = {name for name in stated if getattr(rig, name) != getattr(RigSettings(), name)}
    assert different == {"cameras", "arm", "calibration", "board"}


@pytest.mark.parametrize("page", [page for page in PAGES if "# rig.yaml" in read(page)])
def test_every_file_on_a_page_is_read(tmp_path, page):
    for example in examples(read(page)):
        if example.words == ("rig.yaml",):
            (tmp_path / "rig.yaml").write_text(example.text)
            assert read_rig(tmp_path / "rig.yaml") != RigSettings()
