"""What the pages assume to be there: recordings, clouds and settings, small, under the names that the pages use."""

from __future__ import annotations

import re
import shutil
from importlib.resources import files
from pathlib import Path

import numpy as np
import yaml

from diffcloud.io.calibrations import Calibration, CameraCalibration, write_calibration
from diffcloud.io.clouds import write_ply
from diffcloud.io.episodes import Episode, write_episode
from diffcloud.scene.scenarios import load_scenario
from diffcloud.sensing.cameras import inverse
from tests.cli.invoke import invoke, stage
from tests.docs.examples import Example, examples, read
from tests.estimation.test_fit import clouds_of
from tests.io.ros_clouds import CloudBag
from tests.io.test_recordings import bag
from tests.sensing.charuco_scene import gripper_poses
from tests.sensing.cloth_scene import INTRINSICS, views, write_cloth_episode
from tests.sensing.table_scene import SERIALS, poses, write_table_episode
from tests.sensing.test_calibration import write_board_episode

PARAMS = {
    "scenes": ["lift"],
    "synthesize": {"per_scenario": 1, "image_size": [106, 60]},
    "preprocess": {"raw": {"refine": False, "depth_jump_m": 0.1}, "points": 300},
    "fit": {"solver": {"max_steps": 1, "starts": 1}, "points": 200},
    "train": {"scenes": ["fold"]},
    "evaluate": {"draws": 1, "baselines": ["middle"]},
}
"""In place of params.yaml and the profiles."""
QUICK = {"base": "lift", "nodes": [5, 5], "frames": 5, "steps_per_frame": 1, "recorder": "whole_surface", "points": 200}


def params(folder: Path, name: str = "params.yaml") -> None:
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(yaml.safe_dump(PARAMS))


def own_clouds(folder: Path) -> None:
    """my_clouds/ with gripper.csv of the tutorial's towel: its nodes, where a run puts them."""
    towel = next(example for example in examples(read("docs/own-clouds.md")) if example.words == ("towel.yaml",))
    write(towel, folder)
    invoke("simulate", "towel.yaml", "--out", "true.npz")
    with np.load("true.npz") as run:
        nodes, times = run["nodes"], run["times"]
    for index, frame in enumerate(nodes):
        write_ply(folder / "my_clouds" / f"{index:03d}.ply", frame)
    track = np.column_stack([times, nodes[:, -1]])
    np.savetxt("my_clouds/gripper.csv", track, delimiter=",", header="t_s,x,y,z", comments="")


def cloud_bag(folder: Path) -> None:
    """lift.bag, a ROS recording of clouds with the tool's poses."""
    CloudBag(folder / "lift.bag", "rosbag1").write(tool=lambda held, t, place: held.pose_stamped("/tool_pose", t, place))


def lift_episode(folder: Path) -> None:
    """my_episode.npz of a lift that takes a moment, before a camera."""
    quick(folder)
    invoke("simulate", "quick", "--out", "run.npz")
    meta = {"viewpoints": {"side": [0.8, 0.2, 0.5]}}
    with np.load("run.npz") as run:
        write_episode(folder / "my_episode.npz", Episode.from_frames(list(run["nodes"]), run["times"], meta=meta))


def motions(folder: Path) -> None:
    """Two lifts and a fold of one cloth."""
    for name, scenario, seed in (("a", "lift", 1), ("b", "lift", 2), ("c", "fold", 3)):
        write_episode(folder / f"{name}.npz", clouds_of(load_scenario(scenario), stretching=0.7, seed=seed))


def board(folder: Path) -> None:
    """The gripper with a ChArUco board, and a checkerboard's points of two cameras."""
    rng = np.random.default_rng(0)
    write_board_episode(folder / "raw/episodes/board", gripper_poses(15, rng), rng)
    for name, pose in poses().items():
        place = folder / "PATH" / f"calib_{name}"
        place.mkdir(parents=True)
        robot = np.array([[0.54 + 0.055 * column, 0.11 - 0.055 * row, 0.055] for row in range(5) for column in range(5)])
        seen = (np.c_[robot, np.ones(25)] @ inverse(pose).T)[:, :3]
        np.save(place / "robot_chessboard.npy", robot)
        np.save(place / "cam_chessboard.npy", seen)
        np.save(place / "intrinsics.npy", np.array([615.0, 615.0, 320.0, 240.0]))


def lab(folder: Path) -> None:
    """A trajectory, a calibration, raw episodes, and recordings of other tools."""
    params(folder)
    (folder / "lift.csv").write_text("t_s,x,y,z\n0,0.6,0,0.2\n2,0.6,0,0.3\n")
    ros = {name: f"ros/{name}/aligned_depth_to_color/image_raw" for name in SERIALS}
    table = {serial: (name, poses()[name]) for names in (SERIALS, ros) for name, serial in names.items()}
    cloth = {f"00{index}": (name, view.T_world_camera) for index, (name, view) in enumerate(views().items())}
    cameras = {
        serial: CameraCalibration(serial, INTRINSICS, pose, name=name)
        for serial, (name, pose) in {**table, **cloth}.items()
    }
    write_calibration(folder / "raw/calibration/lab.json", Calibration(cameras, "charuco"))
    write_cloth_episode(folder / "raw/episodes/lift/tan1")
    bag(folder, "mcap").rename(folder / "run.mcap")
    source = write_table_episode(folder / "elsewhere")
    for name, place in (("overhead", "a"), ("side", "b")):
        shutil.copytree(source / "cameras" / name, folder / "png" / place)
        (folder / "png" / place / "timestamps.csv").unlink()
    shutil.copy(source / "robot.csv", folder / "joints.csv")
    (folder / "raw/robot").mkdir()
    urdf = next(path for path in files("diffcloud.sensing").iterdir() if path.name.endswith(".urdf"))
    (folder / "raw/robot/mine.urdf").write_text(urdf.read_text())


def fitted(folder: Path) -> None:
    """Episodes and fits of the pipeline, of a lift that takes a moment."""
    quick(folder)
    stage("synthesize", "--params", "params.yaml", "--out", "data/recorded")
    invoke("data", "preprocess", "--params", "params.yaml", "--out", "data/episodes", "data/recorded")
    stage("fit", "--params", "params.yaml", "--out", "data/fits", "data/episodes")
    params(folder, "pipeline/profiles/release.yaml")


def towel(folder: Path) -> None:
    """towel.npz and its fit, of a lift that takes a moment."""
    (folder / "towel.yaml").write_text(yaml.safe_dump(QUICK))
    write_episode(folder / "towel.npz", clouds_of(load_scenario(folder / "towel.yaml"), stretching=0.7))
    invoke("fit", "--scene", "towel.yaml", "--parameters", "stretching", "--out", "fits", "towel.npz")


def write(example: Example, folder: Path) -> None:
    """The file that a page shows, a towel with fewer nodes and steps."""
    fewer = example.text.replace("nodes: [13, 10]", "nodes: [4, 3]")
    if "nodes: [4, 3]" in fewer:
        fewer = re.sub(r"^steps_per_frame:.*\n", "", fewer, flags=re.MULTILINE) + "steps_per_frame: 2\n"
    (folder / example.words[0]).write_text(fewer)


def quick(folder: Path) -> None:
    """Settings, and a lift that takes a moment."""
    (folder / "raw/scenes").mkdir(parents=True)
    (folder / "raw/scenes/quick.yaml").write_text(yaml.safe_dump(QUICK))
    (folder / "params.yaml").write_text(yaml.safe_dump({**PARAMS, "scenes": ["quick"]}))


def example(folder: Path) -> None:
    """examples/towel.npz, a shorter lift of a towel of the same size."""
    towel = {"base": "lift", "size_m": [0.395, 0.244], "nodes": [9, 6], "frames": 8, "rate_hz": 10, "steps_per_frame": 4}
    (folder / "towel.yaml").write_text(yaml.safe_dump({**towel, "path": [[0, 0, 0, 0], [0.8, 0.0, -0.1, 0.25]]}))
    made = clouds_of(load_scenario(folder / "towel.yaml"), points=1000, stretching=4.0, density=1.2)
    write_episode(folder / "examples" / "towel.npz", made)


PREPARED = {
    "README.md": example,
    "docs/own-clouds.md": cloud_bag,
    "docs/library.md": own_clouds,
    "docs/calibration.md": board,
    "docs/concepts.md": motions,
    "docs/capture.md": lab,
    "docs/evaluation.md": fitted,
    "docs/export.md": towel,
    "docs/pipeline.md": quick,
    "docs/regressors.md": lift_episode,
}
"""Page -> what puts its files into the empty, current folder."""
STAND_INS = {"docs/pipeline.md": {"lift": "quick"}, "docs/regressors.md": {"lift": "quick"}}
"""Page -> word on the page -> what takes its place."""
