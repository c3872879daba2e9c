"""File names that carry a frame number or a time: the number gives the order, and times are used as such."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from diffcloud.errors import EpisodeError
from diffcloud.io.frame_names import named_frames
from diffcloud.io.imports import cloud_folder
from diffcloud.io.raw_episodes import read_raw_episode
from tests.cli.invoke import invoke
from tests.sensing.table_scene import poses, table_depth, write_table_episode

EPOCH = 1_305_031_102_160_407_000


def folder_of(tmp_path, names, suffix=".xyz"):
    folder = tmp_path / "clouds"
    folder.mkdir()
    for name in names:
        (folder / f"{name}{suffix}").write_text("0 0 0\n")
    return folder


def found(tmp_path, names):
    frames = named_frames(folder_of(tmp_path, names), (".xyz",), kind="clouds")
    return [path.stem for path in frames.paths], frames


@pytest.mark.parametrize(
    ("names", "times"),
    [
        (["0.9", "1.0", "1.1"], [0.9, 1.0, 1.1]),
        (["9.5", "10.5", "11.0"], [9.5, 10.5, 11.0]),
        (["0", "0.5", "1", "1.25"], [0, 0.5, 1, 1.25]),
        (["-0.5", "-0.25", "0.0", "0.25"], [-0.5, -0.25, 0, 0.25]),
        (["1e-05", "0.1", "0.2"], [1e-5, 0.1, 0.2]),
        (["frame_000123_1.5", "frame_000124_1.6", "frame_000125_11.0"], [1.5, 1.6, 11.0]),
        (["frame-2_9.5s", "frame-3_10.5s"], [9.5, 10.5]),
        (["1305031102.160407", "1305031102.193707"], [1305031102.160407, 1305031102.193707]),
        (["1305031102_160407000", "1305031102_193707000"], [1305031102.160407, 1305031102.193707]),
        (["cam_Depth_1305031102160.40700", "cam_Depth_1305031102193.7"], [1305031102.160407, 1305031102.1937]),
        (["2011-05-10T12-38-59.900", "2011-05-10T12-39-00.000"], [1305031139.9, 1305031140.0]),
        (["20110510_12:38:59", "20110510_12:39:00"], [1305031139, 1305031140]),
        ([f"{EPOCH}", f"{EPOCH + 33_300_000}"], [1305031102.160407, 1305031102.193707]),
        ([f"d{EPOCH // 1000}", f"d{EPOCH // 1000 + 33_300}"], [1305031102.160407, 1305031102.193707]),
        ([f"{EPOCH // 10**6}", f"{EPOCH // 10**6 + 33}"], [1305031102.160, 1305031102.193]),
        ([f"{EPOCH // 10**9}", f"{EPOCH // 10**9 + 1}"], [1305031102, 1305031103]),
    ],
)
def test_names_that_are_times_give_order_and_times(tmp_path, names, times):
    order, frames = found(tmp_path, names)
    assert order == names
    np.testing.assert_allclose(frames.times, times, rtol=0, atol=3e-7)
    assert frames.numbers == tuple(range(len(names)))


@pytest.mark.parametrize(
    ("names", "numbers"),
    [
        (["8", "9", "10"], (8, 9, 10)),
        (["frame-0001", "frame-0002"], (1, 2)),
        (["-1", "0", "1"], (-1, 0, 1)),
        (["take.0998", "take.0999", "take.1000"], (998, 999, 1000)),
        (["000_cloud", "001_cloud"], (0, 1)),
        (["2011-05-10_000003", "2011-05-10_000004"], (3, 4)),
    ],
)
def test_whole_numbers_are_frames(tmp_path, names, numbers):
    order, frames = found(tmp_path, names)
    assert (order, frames.numbers, frames.times) == (names, numbers, None)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["1", "01"], r"01.xyz and 1.xyz are both frame 1"),
        (["0.5", "0.50"], r"0.5.xyz and 0.50.xyz are both of the time 0.50? s"),
        (["0", "2"], r"frames \[1\] are missing between 0 and 2"),
        (["0", "33333333", "66666666", "100000001"], "neither frame numbers nor times of a recording"),
        (["take1.0001", "take1.0002"], "neither frame numbers nor times of a recording"),
        (["20110510123859", "20110510123900"], "neither frame numbers nor times of a recording"),
        (["left", "right"], "no numbered clouds"),
    ],
)
def test_names_that_say_nothing_for_certain_are_refused(tmp_path, names, message):
    with pytest.raises(EpisodeError, match=message):
        found(tmp_path, names)


class TestClouds:
    """Of a cloth that rises by 1 cm a frame, ten frames a second."""

    NAMES = tuple(f"{0.5 + frame / 10:.1f}" for frame in range(10))

    def clouds(self, tmp_path):
        folder = folder_of(tmp_path, self.NAMES)
        for frame, name in enumerate(self.NAMES):
            (folder / f"{name}.xyz").write_text(f"0 0 {frame / 100}\n1 0 {frame / 100}\n")
        return folder

    @pytest.mark.parametrize("rate_hz", [None, 10.0])
    def test_are_in_order_of_their_times(self, tmp_path, rate_hz):
        episode = cloud_folder(self.clouds(tmp_path), rate_hz=rate_hz)
        np.testing.assert_allclose(episode.times, np.arange(10) / 10, atol=1e-12)
        heights = [float(episode.frame(frame)[:, 2].mean()) for frame in range(10)]
        np.testing.assert_allclose(heights, np.arange(10) / 100, atol=1e-6)

    def test_a_rate_that_disagrees_is_refused(self, tmp_path):
        folder = self.clouds(tmp_path)
        done = invoke("data", "import", folder, "--rate-hz", 30, "--out", tmp_path / "e.npz", code=1)
        assert "the file names are times, 0.5.xyz to 1.4.xyz, at 10 frames a second, but --rate-hz says 30" in done.errors

    def test_times_of_the_gripper_that_disagree_are_refused(self, tmp_path):
        folder = self.clouds(tmp_path)
        track = tmp_path / "g.csv"
        for step, right in ((0.1, True), (0.04, False)):
            track.write_text("t_s,x,y,z\n" + "".join(f"{7 + step * frame},0,0,0\n" for frame in range(10)))
            if right:
                episode = cloud_folder(folder, grippers={"any": track})
                np.testing.assert_allclose(episode.times, np.arange(10) / 10, atol=1e-9)
                continue
            with pytest.raises(EpisodeError, match=r"1.4.xyz is 0.9 s after the first frame, and its row says 0.36 s"):
                cloud_folder(folder, grippers={"any": track})


class TestDepthImages:
    STAMPS = ("1305031102.160407", "1305031102.193707", "1305031102.227007", "1305031102.260307")

    def folder(self, tmp_path, color=()):
        episode = write_table_episode(tmp_path / "made", frames=4)
        folder = tmp_path / "side"
        shutil.copytree(episode / "cameras" / "side", folder)
        (folder / "timestamps.csv").unlink()
        for path, stamp in zip(sorted((folder / "depth").iterdir()), self.STAMPS, strict=True):
            path.rename(path.with_name(f"{stamp}.png"))
        shutil.rmtree(folder / "color", ignore_errors=True)
        if color:
            from PIL import Image

            (folder / "color").mkdir()
            for index, stamp in enumerate(color):
                Image.new("RGB", (160, 120), (index, 0, 0)).save(folder / "color" / f"{stamp}.png")
        return folder

    @pytest.mark.parametrize("options", [(), ("--rate-hz", 30)])
    def test_have_the_times_of_their_names(self, tmp_path, options):
        invoke("data", "import", f"cam={self.folder(tmp_path)}", "--out", tmp_path / "e", *options)
        camera = read_raw_episode(tmp_path / "e").cameras["cam"]
        np.testing.assert_allclose(camera.times, 0.0333 * np.arange(4), atol=1e-6)
        np.testing.assert_array_equal(camera.depth(3), table_depth(poses()["side"]))

    def test_a_rate_or_a_table_that_disagrees_is_refused(self, tmp_path):
        folder = self.folder(tmp_path)
        command = ("data", "import", f"cam={folder}", "--out", tmp_path / "e")
        assert "at 30.03 frames a second, but --rate-hz says 10" in invoke(*command, "--rate-hz", 10, code=1).errors
        (folder / "timestamps.csv").write_text("frame,t_s\n0,0\n1,0.1\n2,0.2\n3,0.3\n")
        assert "are times (1305031102.160407.png), and there is a timestamps.csv" in invoke(*command, code=1).errors

    def test_have_the_nearest_colour(self, tmp_path):
        folder = self.folder(tmp_path, color=("1305031102.175304", "1305031102.211214", "1305031102.243211", "1305031103"))
        invoke("data", "import", f"cam={folder}", "--out", tmp_path / "e")
        camera = read_raw_episode(tmp_path / "e").cameras["cam"]
        red = [None if camera.color(frame) is None else int(camera.color(frame)[0, 0, 0]) for frame in range(4)]
        assert red == [0, 1, 1, 2]  # 15, 17.5 (before: 18.4), 15.8 and 17.1 ms away
        (folder / "color" / "1305031103.png").unlink()
        for index, path in enumerate(sorted((folder / "color").iterdir())):
            path.rename(path.with_name(f"{index}.png"))
        said = invoke("data", "import", f"cam={folder}", "--out", tmp_path / "f", code=1).errors
        assert "are not named alike: one by times, the other by frame numbers" in said

    def test_epoch_in_nanoseconds(self, tmp_path):
        folder = self.folder(tmp_path)
        for path in sorted((folder / "depth").iterdir()):
            path.rename(path.with_name(f"{path.stem.replace('.', '')}000.png"))
        log = tmp_path / "log.csv"
        names = [f"joint_{index}" for index in range(1, 8)]
        rows = [f"{t},{','.join(['0.1'] * 7)},0" for t in ("1305031102.1", "1305031102.3")]
        log.write_text("\n".join([",".join(["t_s", *names, "gripper"]), *rows]) + "\n")
        done = invoke("data", "import", f"cam={folder}", "--out", tmp_path / "e", "--joint-log", log)
        assert done.result["robot_rows"] == 2
        episode = read_raw_episode(tmp_path / "e")
        np.testing.assert_allclose(episode.robot.times, [-0.060407, 0.139593], atol=1e-5)
        assert json.loads((tmp_path / "e" / "episode.json").read_text())["rate_hz"] == pytest.approx(30.03, abs=0.01)
