"""Every kind of file that commands read: a good one, and the command that reads it."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import yaml

from diffcloud.estimation.objective import Objective
from diffcloud.estimation.record import read_fit
from diffcloud.evaluation.record import ComparisonFile, FitRow, PredictionRow, check_file
from diffcloud.hardware.rig import RigSettings, read_rig
from diffcloud.io.calibrations import Calibration, CameraCalibration, read_calibration, write_calibration
from diffcloud.io.clouds import import_open3d
from diffcloud.io.files import read_json
from diffcloud.io.manifests import read_manifest
from diffcloud.io.obj import read_cloth, write_cloth
from diffcloud.io.raw_episodes import read_raw_episode
from diffcloud.io.simulated import SimulatedSet
from diffcloud.jobs.report import table_rows
from diffcloud.jobs.scene_files import find_scene
from diffcloud.jobs.settings import load_config
from diffcloud.scene.scenarios.catalogue import built_in
from diffcloud.sensing.robot import Robot
from diffcloud.sensing.validation.episode import validate_raw_episode
from tests.arcsim.files import sheet_over_box, write_file, write_files
from tests.cli.invoke import ROOT, environment
from tests.conftest import small_lift
from tests.estimation.test_fit import clouds_of
from tests.io.ros_bag import Bag, Habits
from tests.io.ros_clouds import CloudBag
from tests.sensing.table_scene import INTRINSICS, poses

SCENARIO = {
    "nodes": [4, 4], "frames": 4, "steps_per_frame": 1, "points": 200, "integrator": "arcsim",
    "path": [[0.0, 0.0, 0.0, 0.0], [0.4, 0.0, -0.03, 0.09]],
}  # fmt: skip
PARAMS = {
    "scenes": ["small"],
    "synthesize": {"per_scenario": 1, "image_size": [106, 60]},
    "preprocess": {"outlier_neighbours": 5, "points": 200},
    "generate": {"scenes": ["small"], "train": 8, "test": 4},
    "fit": {"solver": {"max_steps": 2}},
    "train": {"scenes": ["small"], "models": ["mlp"], "profile": "quick", "epochs": 2, "points": 24},
    "evaluate": {"draws": 1, "baselines": ["middle"], "landscapes": ["small/small_hidden1"], "landscape_size": 3},
    "report": {},
}
_FITTED = "--params params.yaml --fits data/fits --episodes data/episodes --regressors data/regressors"
STAGES = {
    "episodes": ("pipeline.synthesize --params params.yaml --out data/recorded", "data/recorded"),
    "preprocess": ("data preprocess --params params.yaml --out data/episodes data/recorded", "data/episodes"),
    "simulate": ("network generate --params params.yaml --scene small --out data/simulated/small", "data/simulated/small"),
    "fit": ("pipeline.fit --params params.yaml --out data/fits data/episodes", "data/fits"),
    "train": ("network train --params params.yaml --data data/simulated --out data/regressors", "data/regressors"),
    "evaluate": (f"pipeline.evaluate {_FITTED} --simulated data/simulated --out reports", "reports"),
}
"""Command -> arguments and the folder that it fills: the stages of dvc.yaml, one scenario of those that have several."""
REPORT = f"pipeline.report {_FITTED} --tables reports/tables --out page/index.html"
_RAW, _EPISODE = "data/recorded/small/small_hidden1", "data/episodes/small/small_hidden1.npz"
_CAMERA, _TIMES = f"{_RAW}/cameras/side/camera.json", f"{_RAW}/cameras/side/timestamps.csv"
_FITS, _PREDICTED, _COMPARED = (f"reports/tables/{name}" for name in ("fits.csv", "predictions.csv", "comparison.json"))
_FIT, _NETWORK, _SET = "data/fits/small/small_hidden1", "data/regressors/small/mlp", "data/simulated/small"


@dataclass(frozen=True)
class Kind:
    """A kind of file."""

    name: str
    form: Literal["document", "table", "arrays", "xml", "bytes"]
    file: str
    """Path of the good one in the project."""
    read: Callable[[], object]
    """In the project's folder."""
    most: int = 1000
    """Damages of its form that are tried, drawn at random where there are more."""
    flips: int = 20
    """Damages of its bytes."""
    as_of: str | None = None
    """The kind whose table of outcomes holds; this command reads the same file."""


def make_project(folder: Path) -> None:
    """A small project with the outputs of all stages, and files of all other kinds beside them."""
    (folder / "raw" / "scenes").mkdir(parents=True)
    options = built_in("lift").model_dump(mode="json") | SCENARIO
    told = {key: value for key, value in options.items() if value is not None and key != "name"}
    (folder / "raw" / "scenes" / "small.yaml").write_text(yaml.safe_dump({"base": "lift", **told}, sort_keys=False))
    (folder / "params.yaml").write_text(yaml.safe_dump(PARAMS))
    _run_pipeline(folder)
    (folder / "full.yaml").write_text(yaml.safe_dump(load_config(folder / "params.yaml").model_dump(mode="json")))
    _write_clouds(folder)
    stated = {
        name: CameraCalibration(name, INTRINSICS, pose, 1e-6 * np.eye(6), name, {"rms_px": 0.2})
        for name, pose in poses().items()
    }
    write_calibration(folder / "calibration.json", Calibration(stated, "charuco", {"square_m": 0.04}, "2026-01-01"))
    write_cloth(folder / "cloth.obj", small_lift().scene.build()[0].mesh)
    write_file(write_files(folder), sheet_over_box())
    Bag(folder / "recording.bag", "rosbag1", Habits()).write()
    Bag(folder / "recording", "mcap", Habits()).write()
    CloudBag(folder / "clouds.bag", "rosbag1").write(tool=lambda held, t, place: held.pose_stamped("/tool_pose", t, place))
    for kind, source in (("recorded", folder / "data" / "recorded"), ("given", folder / "data" / "episodes")):
        shutil.copytree(source, folder / "twice" / kind)
        one = next((folder / "twice" / kind).rglob("small_hidden1*"))
        two = one.with_name(one.name.replace("hidden1", "hidden2"))
        shutil.copytree(one, two) if one.is_dir() else shutil.copy(one, two)
    find_scene([folder / _EPISODE], folder / "found", None, None)
    shutil.copy(files("diffcloud.sensing") / "gen3_robotiq_2f_85.urdf", folder / "robot.urdf")
    shutil.copytree(folder / _RAW / "cameras" / "side" / "depth", folder / "images" / "depth")
    shutil.copy(folder / _CAMERA, folder / "images" / "camera.json")
    rows = [f"{0.5 * index},{0.4 + 0.05 * index},0.0,{0.3 + 0.02 * index},0.9" for index in range(6)]
    (folder / "path.csv").write_text("\n".join(["t_s,x,y,z,gripper", *rows]) + "\n")
    setup = {"arm": "a", "preset": "high_accuracy", "laser_power_mw": 240, "master": "side", "time_scale": 2}
    rig = RigSettings.model_validate({"cameras": {"side": "a1"}, **setup})
    (folder / "rig.yaml").write_text(yaml.safe_dump(rig.model_dump(mode="json")))


def _run_pipeline(folder: Path) -> None:
    """`dvc repro` of this project's own stages; they do not depend on the code there."""
    told = yaml.safe_load((ROOT / "dvc.yaml").read_text())
    for stage in told["stages"].values():
        stage["deps"] = [path for path in stage.get("deps", []) if not path.startswith(("diffcloud", "pipeline"))]
    (folder / "dvc.yaml").write_text(yaml.safe_dump({"stages": told["stages"]}, sort_keys=False))
    for arguments in (["init", "--no-scm"], ["config", "core.analytics", "false"], ["repro"]):
        line = [sys.executable, "-m", "dvc", *arguments, "--quiet"]
        subprocess.run(line, cwd=folder, env=environment(), check=True, capture_output=True)


def _write_clouds(folder: Path) -> None:
    """Three clouds in each format, and the track of a gripper."""
    draw = np.random.default_rng(0)
    for form in ("ply", "pcd", "xyz", "npy", "npz"):
        (folder / form).mkdir()
    for index in range(3):
        points = (draw.normal(size=(60, 3)) / 10).astype(np.float32)
        text = "".join(" ".join(f"{value:.6f}" for value in point) + "\n" for point in points)
        axes = "".join(f"property float {axis}\n" for axis in "xyz")
        (folder / "ply" / f"{index}.ply").write_text(f"ply\nformat ascii 1.0\nelement vertex 60\n{axes}end_header\n{text}")
        head = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 60\nHEIGHT 1\nPOINTS 60\nDATA ascii\n"
        (folder / "pcd" / f"{index}.pcd").write_text(head + text)
        (folder / "xyz" / f"{index}.xyz").write_text(text)
        np.save(folder / "npy" / f"{index}.npy", points)
    rows = [f"{index / 10},0,0,{0.1 + index / 50}" for index in range(3)]
    (folder / "gripper.csv").write_text("\n".join(["t_s,x,y,z", *rows]) + "\n")


def command(arguments: str) -> Callable[[], None]:
    """`diffcloud` with these arguments, in this process."""

    def run() -> None:
        from tests.cli.invoke import main

        sys.argv = ["diffcloud", *arguments.split()]
        main()

    return run


def _cleaned() -> None:
    """`data preprocess`, with which `data check` must agree."""
    faults = [one.message for one in validate_raw_episode(Path(_RAW)) if one.severity == "fault"]
    try:
        command("data preprocess --params params.yaml --out cleaned data/recorded")()
    except SystemExit as end:
        if end.code and not faults:
            print("Traceback: data check finds nothing wrong in what preprocess refuses")
        raise


def _scene_of_recording() -> None:
    """`fit`, up to its fit."""
    _, cloth, layouts = find_scene([Path(_EPISODE)], Path("found"), None, None)
    print(sorted(cloth), sorted(layouts))


def _left(model: object, path: str) -> Callable[[], None]:
    """The check of a file that `evaluate` has left."""
    read = read_json if path.endswith(".json") else table_rows
    return lambda: check_file(model, Path(path), read(Path(path)))


_IMPORT = "data import {} --gripper gripper.csv --out imported.npz"
_CAPTURE = command("data capture --dry-run --trajectory path.csv --rig rig.yaml --out e")
_REPORT = command(REPORT)
_IMAGES = command("data import a=images --rate-hz 10 --out imported")
_LOSS = command(f"fit {_EPISODE} --scene small --parameters stretching --solver random_search --out fitted --threads 1")
_OF_FIT = command(f"simulate {_FIT}.json --track {_EPISODE} --frames 1 --out m.npz")
_PREDICT = command(f"network predict {_EPISODE} --checkpoint {_NETWORK}.safetensors")
KINDS = (
    Kind(
        "scenario", "document", "raw/scenes/small.yaml", command("simulate raw/scenes/small.yaml --out m.npz")
    ),
    Kind("params", "document", "full.yaml", lambda: load_config(Path("full.yaml"))),
    Kind("ARCSim scene", "document", "conf/scene.json", command("simulate conf/scene.json --frames 2 --out m.npz")),
    Kind("episode", "arrays", _EPISODE, _LOSS),
    Kind("gripper track", "table", "gripper.csv", command(_IMPORT.format("ply"))),
    *(Kind(f"cloud, {form}", "bytes", f"{form}/1.{form}", command(_IMPORT.format(form)), flips=60)
      for form in ("ply", "pcd", "xyz", "npy")),
    Kind("episode.json", "document", f"{_RAW}/episode.json", lambda: read_raw_episode(Path(_RAW))),
    Kind("camera.json", "document", _CAMERA, lambda: read_raw_episode(Path(_RAW))),
    Kind("timestamps.csv", "table", _TIMES, lambda: read_raw_episode(Path(_RAW))),
    Kind("robot.csv", "table", f"{_RAW}/robot.csv", lambda: read_raw_episode(Path(_RAW))),
    *(Kind(f"{name}, preprocessed", form, file, _cleaned, most=24, flips=6, as_of=name)
      for name, form, file in (
          ("episode.json", "document", f"{_RAW}/episode.json"), ("camera.json", "document", _CAMERA),
          ("timestamps.csv", "table", _TIMES), ("robot.csv", "table", f"{_RAW}/robot.csv"))),
    Kind("depth image", "bytes", f"{_RAW}/cameras/side/depth/000001.png", _cleaned),
    Kind("colour image", "bytes", f"{_RAW}/cameras/side/color/000001.png", _cleaned),
    Kind("calibration", "document", "calibration.json", lambda: read_calibration(Path("calibration.json"))),
    Kind("fit, record", "document", f"{_FIT}.json", lambda: read_fit(Path(f"{_FIT}.json"))),
    Kind("fit, record, evaluated", "document", f"{_FIT}.json", _OF_FIT, most=40, as_of="fit, record"),
    Kind("fit, record, reported", "document", f"{_FIT}.json", _REPORT, most=12, flips=4, as_of="fit, record"),
    Kind("fit, motion", "arrays", f"{_FIT}.npz", command(f"export {_FIT}.json --to obj --out exported")),
    Kind("manifest", "document", "data/fits/manifest.json", lambda: read_manifest(Path("data/fits"))),
    Kind("network", "bytes", f"{_NETWORK}.safetensors", _PREDICT, flips=60),
    Kind("simulated set", "document", f"{_SET}/set.json", lambda: SimulatedSet.read(Path(_SET), "train")),
    Kind("runs", "table", f"{_SET}/train.csv", lambda: SimulatedSet.read(Path(_SET), "train")),
    Kind("surface", "arrays", f"{_SET}/surface.npz", lambda: SimulatedSet.read(Path(_SET), "train")),
    Kind("nodes", "bytes", f"{_SET}/train_nodes.npy", lambda: SimulatedSet.read(Path(_SET), "train"), flips=60),
    Kind("fits", "table", _FITS, _left(list[FitRow], _FITS)),
    Kind("predictions", "table", _PREDICTED, _left(list[PredictionRow], _PREDICTED)),
    Kind("comparison", "document", _COMPARED, _left(ComparisonFile, _COMPARED)),
    *(Kind(f"{name}, reported", form, file, _REPORT, most=12, flips=4, as_of=name)
      for name, form, file in (
          ("fits", "table", _FITS), ("predictions", "table", _PREDICTED), ("comparison", "document", _COMPARED))),
    Kind("cloth.yaml", "document", "found/cloth.yaml", _scene_of_recording),
    Kind("recordings.yaml", "document", "found/recordings.yaml", _scene_of_recording),
    Kind("URDF", "xml", "robot.urdf", lambda: Robot.from_urdf(Path("robot.urdf")), most=200, flips=40),
    Kind("depth folder, camera", "document", "images/camera.json", _IMAGES),
    Kind("depth folder, image", "bytes", "images/depth/000001.png", _IMAGES),
    Kind("mesh", "bytes", "cloth.obj", lambda: read_cloth(Path("cloth.obj")), flips=80),
    Kind("ROS bag", "bytes", "recording.bag", command("data import recording.bag --out imported")),
    Kind("ROS bag of clouds", "bytes", "clouds.bag", command("data import clouds.bag --out imported.npz")),
    Kind("MCAP", "bytes", "recording/recording.mcap", command("data import recording --out imported")),
    Kind("trajectory", "table", "path.csv", _CAPTURE),
    Kind("rig", "document", "rig.yaml", lambda: read_rig(Path("rig.yaml"))),
)  # fmt: skip


def warm_up() -> None:
    """Import and compile in this process what its forks would each import and compile."""
    import matplotlib.figure

    import studies.published

    del matplotlib, studies
    import_open3d()
    torch.set_num_threads(1)
    for integrator in ("arcsim", "implicit"):
        scenario = small_lift(integrator=integrator)
        parameters = {"stretching": torch.ones(1, dtype=torch.float64)}
        Objective(scenario, clouds_of(scenario, stretching=1.0))(parameters)
