"""The capture code on two software D435s: alignment, recording, playback, and a camera that stops mid-run."""

from __future__ import annotations

import time

import numpy as np
import pytest

from diffcloud.errors import HardwareError
from diffcloud.hardware import CaptureSettings, camera_settings, capture
from diffcloud.hardware.camera_settings import CameraSettings
from diffcloud.hardware.realsense import (
    RealSenseCamera,
    connected_cameras,
    import_realsense,
    play_recording,
    play_recordings,
)
from diffcloud.io.files import write_json
from diffcloud.io.raw_episodes import read_camera_info, read_raw_episode
from diffcloud.sensing.validation.episode import validate_raw_episode
from tests.hardware.simulated import PointArm, short_path
from tests.hardware.software_cameras import CX, CY, DEPTH_SCALE, FPS, FX, FY, HEIGHT, WIDTH, Cameras, numbered_depth

try:
    rs = import_realsense()
except HardwareError as error:
    pytest.skip(f"pyrealsense2 is not installed (pip install diffcloud[hardware]): {error}", allow_module_level=True)


@pytest.fixture
def make_cameras():
    made = []

    def make(**options):
        made.append(Cameras(rs, **options))
        return made[-1]

    yield make
    for cameras in made:
        cameras.stop()


def opened(cameras, recordings=None):
    size = {"width": WIDTH, "height": HEIGHT, "fps": FPS}
    return [
        RealSenseCamera(name, serial, context=cameras.context, record_to=(recordings or {}).get(name), **size)
        for name, serial in zip(("overhead", "side"), cameras.SERIALS, strict=True)
    ]


def test_connected_cameras_are_listed(make_cameras):
    found = connected_cameras(make_cameras().context)
    assert [camera["serial"] for camera in found] == ["111111111111", "222222222222"]
    assert found[0]["name"] == "Intel RealSense D435"


def test_a_serial_that_is_not_there(make_cameras):
    camera = RealSenseCamera("side", "999", context=make_cameras().context)
    with pytest.raises(HardwareError, match="no serial 999; connected are 111111111111, 222222222222"):
        camera.open()
    with pytest.raises(HardwareError, match="not open"):
        camera.read(0.1)


def test_a_hundred_pairs_recorded_written_and_played_back_bit_by_bit(tmp_path, make_cameras):
    """Line by line: alignment, recording to .db3, the episode's PNGs, playback; nothing lost, nothing changed."""
    cameras = make_cameras()
    recordings = {name: tmp_path / f"{name}.db3" for name in ("overhead", "side")}
    devices = opened(cameras, recordings)

    def feed_once_recording(text):
        if text == "recording":
            cameras.feed(count=104)

    settings = CaptureSettings(rate_hz=60.0, camera_timeout_s=1.5, durable=False)
    with pytest.raises(HardwareError, match="delivered no frame"):  # once all 104 have come, however busy the machine is
        capture(tmp_path / "e", devices, seconds=60, tell=feed_once_recording, settings=settings)
    assert [device.dropped for device in devices] == [0, 0]
    episode = read_raw_episode(tmp_path / "e")
    for index, (name, camera) in enumerate(episode.cameras.items()):
        info = camera.info
        assert info.depth_scale_m == DEPTH_SCALE
        held = info.intrinsics
        assert (held.fx, held.fy, held.cx, held.cy) == pytest.approx((FX, FY, CX, CY), rel=1e-6)
        assert (held.width, held.height) == (WIDTH, HEIGHT)
        numbers = [int(camera.depth(frame)[0, 0]) for frame in range(len(camera.frames))]
        assert len(numbers) == 104
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))  # none lost
        for frame in (0, 50, 99):
            np.testing.assert_array_equal(camera.depth(frame), numbered_depth(numbers[frame], index))
            assert (camera.color(frame) == numbers[frame] % 256).all()
        np.testing.assert_allclose(np.diff(camera.times), 1 / FPS, atol=2e-3)

        with play_recording(recordings[name], name) as (played, frames):
            assert (played.serial, played.depth_scale_m) == (info.serial, DEPTH_SCALE)
            assert played.intrinsics == held
            again = []
            for frame in frames:
                number = int(frame.depth[0, 0])
                np.testing.assert_array_equal(frame.depth, numbered_depth(number, index))
                again.append(number)
        assert again == numbers


def test_the_usual_scale_comes_back_exactly(tmp_path, make_cameras):
    cameras = make_cameras(depth_scale=0.001)
    camera = opened(cameras, {"overhead": tmp_path / "a.db3"})[0]
    assert camera.open().depth_scale_m == 0.001
    for number in range(1, 4):
        cameras.cameras[0].push_numbered(number, time.time() * 1000 + 17 * number)
    camera.read(2.0)
    camera.close()
    with play_recording(tmp_path / "a.db3", "overhead") as (info, frames):
        assert info.depth_scale_m == 0.001
        assert len(list(frames)) >= 1


@pytest.mark.parametrize("domain", ["system_time", "hardware_clock"])
def test_recordings_on_the_cameras_own_clocks_are_not_brought_together(tmp_path, make_cameras, domain):
    cameras = make_cameras(domain=domain)
    paths = {name: tmp_path / f"{name}.db3" for name in ("overhead", "side")}
    for index, camera in enumerate(opened(cameras, paths)):
        camera.open()
        for number in range(1, 4):
            cameras.cameras[index].push_numbered(number, time.time() * 1000 + 17 * number)
        camera.read(2.0)
        camera.close()
    if domain == "system_time":
        with play_recordings(paths) as recording:
            assert {frame.camera for frame in recording.frames} == set(paths)
        return
    with pytest.raises(HardwareError, match=r"by the camera's own clock.*Import each"), play_recordings(paths) as both:
        list(both.frames)
    with play_recordings({"side": paths["side"]}) as alone:
        assert len(list(alone.frames)) >= 1


@pytest.mark.parametrize("change_s", [-3600.0, 3600.0])
def test_a_clock_that_is_set_while_recording_loses_no_frame(tmp_path, make_cameras, monkeypatch, change_s):
    """Stamps are the computer's time of day; after a third of the frames somebody sets it."""
    cameras = make_cameras()
    right = time.time
    monkeypatch.setattr(time, "time", lambda: right() + (change_s if cameras.pushed >= 40 else 0.0))

    def feed_once_recording(text):
        if text == "recording":
            cameras.feed(count=120)

    settings = CaptureSettings(rate_hz=60.0, camera_timeout_s=1.5, durable=False)
    with pytest.raises(HardwareError, match="delivered no frame"):  # once all have come
        capture(tmp_path / "e", opened(cameras), seconds=60, tell=feed_once_recording, settings=settings)
    for camera in read_raw_episode(tmp_path / "e").cameras.values():
        numbers = [int(camera.depth(index)[0, 0]) for index in range(len(camera.frames))]
        assert numbers == list(range(1, 121))
        np.testing.assert_allclose(np.diff(camera.times), 1 / FPS, atol=5e-3)


def test_depth_is_aligned_to_a_colour_camera_beside_it(make_cameras):
    """Colour 15 mm to the side: a wall's left edge moves by f b / z pixels."""
    cameras = make_cameras(baseline_m=0.015)
    camera = opened(cameras)[0]
    camera.open()
    try:
        depth = np.zeros((HEIGHT, WIDTH), np.uint16)
        depth[:, 100:300] = 40
        color = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        for number in range(1, 4):
            cameras.cameras[0].push(number, depth, color, time.time() * 1000 + 33 * number)
        frame = camera.read(2.0)
    finally:
        camera.close()
    columns = np.flatnonzero(frame.depth[120] > 0)
    assert columns[0] - 100 == pytest.approx(FX * 0.015 / (40 * DEPTH_SCALE), abs=1.0)
    assert (frame.depth[120][columns] == 40).all()


def test_a_camera_that_stops_mid_run_ends_the_capture_and_stops_the_arm(tmp_path, make_cameras):
    cameras = make_cameras()
    arm = PointArm()

    def feed_once_recording(text):
        if text == "recording":
            cameras.feed(dies_after=100)

    # the camera's silence ends the capture however late its frames come: a busy machine takes its time to push them
    settings = CaptureSettings(rate_hz=10.0, hold_s=60.0, camera_timeout_s=1.5, durable=False)
    with pytest.raises(HardwareError, match=r"Camera side \(222222222222\) delivered no frame for 1.5 s: unplugged"):
        capture(
            tmp_path / "e",
            opened(cameras),
            arm=arm,
            trajectory=short_path(0.05, 0.8),
            settings=settings,
            tell=feed_once_recording,
        )
    assert arm.stopped
    assert "twist" in arm.events
    cameras.stop()
    episode = read_raw_episode(tmp_path / "e")
    assert episode.description["status"] == "stopped"
    side = episode.cameras["side"]
    numbers = [int(side.depth(index)[0, 0]) for index in range(len(side.frames))]
    assert numbers[-1] == 100  # all frames so far
    faults = {finding.code for finding in validate_raw_episode(tmp_path / "e") if finding.severity == "fault"}
    assert "truncated_image" not in faults


class TestSettings:
    @pytest.fixture
    def cameras(self, make_cameras):
        return make_cameras(settable=True)

    def opened(self, cameras, index=0, **settings):
        size = {"width": WIDTH, "height": HEIGHT, "fps": FPS}
        camera = RealSenseCamera(
            "a", cameras.SERIALS[index], context=cameras.context, settings=CameraSettings(**settings), **size
        )
        return camera, camera.open()

    def value(self, cameras, kind, name, index=0):
        return cameras.cameras[index].sensors[kind].get_option(getattr(rs.option, name))

    def test_what_the_camera_found_is_held_and_kept(self, cameras, tmp_path):
        for kind, name, value in (("depth", "exposure", 7000), ("depth", "gain", 32), ("color", "white_balance", 5200)):
            cameras.cameras[0].sensors[kind].set_option(getattr(rs.option, name), value)  # what it finds by itself
        camera, info = self.opened(cameras)
        camera.close()
        assert self.value(cameras, "depth", "enable_auto_exposure") == 0
        assert self.value(cameras, "color", "enable_auto_white_balance") == 0
        assert info.settings["depth.exposure"] == 7000
        assert info.settings["depth.gain"] == 32
        assert info.settings["color.white_balance"] == 5200
        write_json(tmp_path / "camera.json", info.to_json())
        assert read_camera_info(tmp_path / "camera.json").settings == info.settings

    def test_exposure_may_follow_the_picture(self, cameras):
        cameras.cameras[0].sensors["depth"].set_option(rs.option.enable_auto_exposure, 0)  # left so by a former program
        camera, info = self.opened(cameras, hold=False)
        camera.close()
        assert info.settings["depth.enable_auto_exposure"] == 1

    def test_laser_preset_and_pace(self, cameras):
        camera, info = self.opened(cameras, preset="high_accuracy", laser_mw=240.0, pace="slave")
        camera.close()
        told = info.settings
        assert (told["depth.laser_power"], told["depth.emitter_enabled"], told["depth.inter_cam_sync_mode"]) == (240, 1, 2)
        assert told["depth.visual_preset"] == int(rs.rs400_visual_preset.high_accuracy)
        camera, info = self.opened(cameras, laser_mw=0.0)
        camera.close()
        assert info.settings["depth.emitter_enabled"] == 0

    @pytest.mark.parametrize(
        ("settings", "message"),
        [
            ({"preset": "best"}, "Camera a: Unknown preset 'best'"),
            ({"laser_mw": 1000.0}, "laser_power is from 0 to 360, got 1000"),
        ],
    )
    def test_what_cannot_be_set_is_said_and_the_camera_closed(self, cameras, settings, message):
        with pytest.raises(HardwareError, match=message):
            self.opened(cameras, **settings)
        camera, _ = self.opened(cameras)  # nobody holds it
        camera.close()

    @pytest.mark.parametrize("step", ["apply", "hold", "read_back"])
    def test_an_error_of_the_sdk_closes_the_camera_too(self, cameras, monkeypatch, step):
        def fail(*_):
            raise RuntimeError("xioctl(VIDIOC_S_CTRL) failed")

        with monkeypatch.context() as broken:
            broken.setattr(camera_settings, step, fail)
            with pytest.raises(HardwareError, match=r"Camera a \(111111111111\) could not be set: xioctl"):
                self.opened(cameras)
        camera, _ = self.opened(cameras)  # nobody holds it
        camera.close()

    def test_a_camera_without_such_an_option(self, make_cameras):
        with pytest.raises(HardwareError, match="Camera a has no option emitter_enabled"):
            self.opened(make_cameras(), laser_mw=100.0)


def test_what_is_no_recording(tmp_path):
    (tmp_path / "x.db3").write_bytes(b"nothing")
    with (
        pytest.raises(HardwareError, match="not a RealSense recording"),
        play_recording(tmp_path / "x.db3", "side"),
    ):
        pass
    with pytest.raises(HardwareError, match="No such recording"), play_recording(tmp_path / "none.db3", "side"):
        pass
    with pytest.raises(HardwareError, match=r"writes recordings as \.db3"):
        RealSenseCamera("side", "1", record_to=tmp_path / "x.bag", context=Cameras(rs).context).open()
