"""`diffcloud fit` as a new user runs it: folders of clouds in, parameters and a report out."""

from __future__ import annotations

import contextlib
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

import diffcloud as dc
from diffcloud.clouds import SurfaceSampler
from diffcloud.errors import ConfigError, EpisodeError
from diffcloud.estimation import task
from diffcloud.estimation.likelihood.descent import Descent
from diffcloud.estimation.record import read_fit
from diffcloud.estimation.result import read_motion
from diffcloud.estimation.settings import LikelihoodSolver
from diffcloud.io.clouds import read_cloud, write_ply
from diffcloud.io.episodes import Episode, write_episode
from diffcloud.io.raw_episodes import read_raw_episode
from diffcloud.jobs import scene_files
from diffcloud.jobs.dvc_project import make_project
from diffcloud.jobs.fits import FitJob
from diffcloud.jobs.preprocess import Cleaned, PreprocessJob
from diffcloud.jobs.scene_files import find_scene
from diffcloud.scene.scenarios import built_in, make_scenario
from diffcloud.sim.simulate import rollout
from tests.cli.invoke import DIFFCLOUD, environment, invoke, study
from tests.io import ros_clouds
from tests.io.ros_bag import bag
from tests.io.test_ros_choices import desired
from tests.io.test_ros_choices import written as baselines
from tests.sensing.table_scene import HOME_RAD, write_table_episode
from tests.test_architecture import check_commands

SIZE = (0.16, 0.12)


@pytest.fixture(scope="module")
def towel(tmp_path_factory):
    """Two lifts of one small cloth, laid differently, as folders of clouds with the gripper's track."""
    root = tmp_path_factory.mktemp("recorded")
    material = {"density_kg_m2": 0.25, "stretching_n_m": 10.0, "bending_n_m": 5e-6, "poisson": 0.2}
    for name, yaw, centre in (("first", 10.0, (0.5, 0.0)), ("second", -35.0, (0.45, 0.1))):
        changes = {
            "size_m": SIZE, "nodes": (13, 10), "yaw_deg": yaw, "center_m": centre, "table_height_m": 0.02, "frames": 8,
            "material": material, "path": [(0, 0, 0, 0), (0.8, -0.03, -0.02, 0.15)], "grasped": ("right_top",),
        }  # fmt: skip
        options = type(built_in("lift")).model_validate({**built_in("lift").model_dump(), **changes})
        scenario = make_scenario(options).finer()  # as a real cloth is
        system, _ = scenario.scene.build()
        run = rollout(system, scenario.steps, properties=scenario.properties(system, {"density": torch.ones(1).double()}))
        nodes = run.positions[0, :: scenario.scene.frame_steps]
        generator = torch.Generator().manual_seed(1)
        sampler = SurfaceSampler.build(torch.as_tensor(system.mesh.faces), 1200, generator=generator)
        rng, folder = np.random.default_rng(2), root / name
        folder.mkdir()
        for index, cloud in enumerate(sampler.sample(nodes).numpy()):
            write_ply(folder / f"{index:03d}.ply", cloud + 0.001 * rng.standard_normal(cloud.shape))
        track = np.column_stack([np.arange(9) * 0.1, nodes[:, scenario.grasped].mean(1).numpy()])
        np.savetxt(folder / "gripper.csv", track, delimiter=",", header="t_s,x,y,z", comments="")
    return root


@pytest.fixture
def work(towel, tmp_path):
    shutil.copytree(towel, tmp_path / "recorded")
    with contextlib.chdir(tmp_path):
        yield tmp_path


COMMAND = ("fit", "recorded/first", "recorded/second", "--size", "0.16x0.12", "--density", 0.25, "--out", "found")
QUICK = ("--parameters", "stretching", "--starts", 1)


@pytest.fixture(scope="module")
def found(towel, tmp_path_factory):
    folder = tmp_path_factory.mktemp("identified")
    shutil.copytree(towel, folder / "recorded")
    with contextlib.chdir(folder):
        done = invoke(*COMMAND, "--parameters", "stretching")
    return folder, done


class TestNewUser:
    def test_what_was_found_can_be_looked_at(self, found):
        folder, _ = found
        with contextlib.chdir(folder):
            episodes = sorted(Path("found/episodes").glob("*.npz"))
            done = invoke("view", *episodes, "--fit", "found/fit.json", "--out", "look.html")
        assert done.result["episodes"] == len(episodes) == 2
        assert (folder / "look.html").read_text(encoding="utf-8").count('"name":"fitted, where the scene has it"') == 2

    def test_the_stiffness_comes_out_in_newtons_per_metre(self, found):
        _, done = found
        told = done.result["parameters"]["stretching"]
        assert told["unit"] == "N/m"
        assert told["value"] == pytest.approx(10.0, rel=0.4)
        assert told["low"] < told["value"] < told["high"]
        assert done.result["fits_to_noise"]
        assert done.result["rms_mm"] < 5

    def test_what_was_found_is_written_with_its_reasons(self, found):
        folder, _ = found
        text = (folder / "found" / "recordings.yaml").read_text()
        assert "  # turn at which that rectangle is smallest" in text
        layouts = yaml.safe_load(text)
        assert layouts["first"]["center_m"] == pytest.approx([0.5, 0.0], abs=0.003)
        apart = (layouts["second"]["yaw_deg"] + 35) % 180
        assert min(apart, 180 - apart) < 2
        cloth = yaml.safe_load((folder / "found" / "cloth.yaml").read_text())
        assert cloth["size_m"] == [0.16, 0.12]
        assert cloth["material"]["density_kg_m2"] == 0.25

    def test_the_report_begins_with_what_it_means(self, found):
        folder, done = found
        page = (folder / "found" / "report.html").read_text()
        summary = page[page.index('id="summary"') :]
        follows, held_out = done.result["findings"][0], done.result["held_out"]
        assert held_out.startswith(("The parameters predict other recordings", "The parameters do not predict"))
        status = "Fits to the noise"
        assert summary.index(status) < summary.index("stretching") < summary.index(held_out) < summary.index(follows)
        assert "fetch(" not in page[: page.index("<main>")]
        assert follows.startswith("The simulation follows first")
        panel = " ".join(done.errors.replace("│", " ").split())
        assert all(text in panel for text in (status, held_out, follows, *done.result["next_steps"], "found/report.html"))
        assert 0.2 < min(done.result["horizons_s"].values()) <= max(done.result["horizons_s"].values()) <= 0.8

    @pytest.mark.slow
    def test_a_mass_that_is_not_exact_is_a_source(self, found):
        """A tenth of the mass is a tenth of the stiffness: a motion tells their ratio."""
        folder, done = found
        with contextlib.chdir(folder):
            words = [*COMMAND[:-1], "weighed", "--density", "0.25+-0.05", "--parameters", "stretching"]
            told = invoke(*words).result["parameters"]["stretching"]
            sources = json.loads(Path("weighed/intervals.json").read_text())["sources"]
        assert sources["density"]["stretching"] == pytest.approx(0.18, abs=0.06)
        exact = done.result["parameters"]["stretching"]
        assert told["high"] / told["low"] > exact["high"] / exact["low"]

    def test_the_grasp_that_was_found_is_in_the_scenarios(self, found):
        folder, done = found
        size = json.loads((folder / "found/fit.json").read_text())["estimate"]["grip_m"]
        assert f"The grasp is {1e3 * size:.0f} mm wide, as the fit found it." in done.result["findings"]
        for name in ("first", "second"):
            scenario = yaml.safe_load((folder / f"found/scenes/{name}.yaml").read_text())
            assert (scenario["grip_m"], scenario["grip_known_within"]) == (pytest.approx(size), 1.0)

    def test_other_commands_take_what_it_wrote(self, found):
        folder, _ = found
        with contextlib.chdir(folder):
            record = read_fit(folder / "found" / "fit.json")
            assert [one.name for one in record.episodes] == ["first", "second"]
            done = invoke("simulate", "found/fit.json", "--track", "found/episodes/second.npz", "--out", "run.npz")
            assert done.result["parameters"] == pytest.approx({name: one.value for name, one in record.parameters.items()})
            assert "not among the fit's recordings" not in done.errors
            moved = np.load("run.npz")["nodes"]
            np.testing.assert_allclose(moved, read_motion(Path("found/fit.npz"), 1).nodes, atol=1e-6)

    def test_what_belongs_to_a_fit_stays_until_another_is_done(self, found, tmp_path, monkeypatch):
        """A run that is stopped leaves fit and scenarios of the one before."""
        folder = shutil.copytree(found[0], tmp_path, dirs_exist_ok=True)

        def stopped(self, tell):
            raise KeyboardInterrupt

        with contextlib.chdir(folder):
            path = Path("found/cloth.yaml")
            path.write_text(path.read_text().replace("steps_per_frame: 8", "steps_per_frame: 16"))
            before = {one: one.read_bytes() for one in [*Path("found/scenes").iterdir(), Path("found/fit.json")]}
            monkeypatch.setattr(FitJob, "run", stopped)
            invoke(*COMMAND, *QUICK, code=130)
            assert before == {one: one.read_bytes() for one in before}

    def test_a_link_to_a_raw_episode_keeps_its_name(self, tmp_path, monkeypatch):
        write_table_episode(tmp_path / "kept" / "0f3e", frames=1)
        (tmp_path / "tan1").symlink_to(tmp_path / "kept" / "0f3e")

        def cleaned(self, tell):
            write_episode(
                self.out / self.scenario / f"{self.name}.npz", Episode.from_frames([np.ones((3, 3))], np.zeros(1))
            )
            return Cleaned({}, [])

        monkeypatch.setattr(PreprocessJob, "run", cleaned)
        assert scene_files.read_recording(tmp_path / "tan1", "tan1", tmp_path / "found", (), keep=True).frame_count == 1

    def test_another_recording_of_that_name_is_told(self, found, tmp_path):
        folder = shutil.copytree(found[0], tmp_path, dirs_exist_ok=True)
        out, recordings = folder / "found", [folder / "recorded" / name for name in ("first", "second")]
        told = []
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(scene_files, "warn", told.append)
            find_scene(recordings, out, None, None)
            assert told == []
            track = folder / "recorded" / "first" / "gripper.csv"
            rows = np.loadtxt(track, delimiter=",", skiprows=1)
            rows[-1, 3] += 0.01
            np.savetxt(track, rows, delimiter=",", header="t_s,x,y,z", comments="")
            find_scene(recordings, out, None, None)
            assert len(told) == 1
            assert told[0].startswith("first is another recording than that")
            notes = out / "recordings.yaml"
            text = notes.read_text()
            notes.write_text(text[: text.index("first:")] + text[text.index("second:") :])
            find_scene(recordings, out, None, None)
            find_scene(recordings, out, None, None)
        assert len(told) == 1

    @pytest.mark.slow
    def test_an_edited_value_overrules_and_a_finished_fit_is_kept(self, found, tmp_path):
        shared, first = found
        folder = shutil.copytree(shared, tmp_path, dirs_exist_ok=True)  # other tests look at the fit, too
        with contextlib.chdir(folder):
            before = (folder / "found" / "fit.json").stat().st_mtime_ns
            again = invoke(*COMMAND, "--parameters", "stretching")
            assert (folder / "found" / "fit.json").stat().st_mtime_ns == before
            assert again.result["parameters"] == first.result["parameters"]
            path = folder / "found" / "recordings.yaml"
            path.write_text(path.read_text().replace("grasped: [right_top]", "grasped: [right_bottom]"))
            other = invoke(*COMMAND, "--parameters", "stretching")
            assert other.result["rms_mm"] > 2 * first.result["rms_mm"]
            assert not other.result["fits_to_noise"]
            assert other.result["findings"][0].startswith("The simulation does not fit the recordings")
            assert other.result["parameters"]["stretching"]["status"] == "model_error"


class TestRefusals:
    @pytest.mark.parametrize(
        ("change", "message"),
        [
            (("--size", "0.40x0.30"), "was stated. Check --size"),
            (("--size", "big"), "--size takes two sides in metres"),
            (("--density", -1), "--density is in kg per square metre"),
            (("--density", "0.25+-0.2"), "below half of it, as in 0.24+-0.01"),
            (("--density", "light"), "got 'light'"),
            (("--level", 1.5), "--level"),
            (("--scene", "lift"), "leave them out beside a known one"),
            (("--out", "recorded/first/gripper.csv"), "--out takes a folder"),
        ],
    )
    def test_of_options(self, work, change, message):
        assert message in invoke(*COMMAND, *change, code=1).errors
        assert not (work / "found" / "fit.json").exists()

    def test_of_what_is_not_there(self, work):
        assert "No such recording: nothing" in invoke("fit", "nothing", "--out", "found", code=1).errors
        (work / "recorded/first/gripper.csv").unlink()
        assert "holds no gripper.csv" in invoke("fit", "recorded/first", "--out", "found", code=1).errors

    def test_of_a_bag_comes_after_it_was_read(self, work):
        """It shows a table without a cloth, which is what is refused."""
        for kind in ("mcap", "rosbag2"):
            (work / kind).mkdir()
            path = bag(work / kind, kind)
            said = invoke("fit", path, "--size", "0.16x0.12", "--out", "found", code=1).errors
            name = path.stem if path.is_file() else path.name
            assert said.startswith(f"{path}: ")
            assert read_raw_episode(work / "found" / "recordings" / name).robot is not None
            file = path if path.is_file() else next(iter(path.glob("*.db3")))
            os.utime(file, ns=(0, 0))
            said = invoke("fit", path, "--size", "0.16x0.12", "--out", "found", code=1).errors
            assert f"was made of another {path.name}" in said
            shutil.rmtree(work / "found")
        (work / "d435.bag").write_bytes(b"#ROSBAG V2.0 /device_0/sensor_0/info")
        said = invoke("fit", "d435.bag", "--out", "found", code=1).errors
        assert "is a recording of the RealSense SDK" in said

    def test_of_a_bag_with_several_topics_names_them(self, work):
        """As `data import` does; the topic that is named is the one that is read."""
        baselines(work, other=desired)
        said = invoke("fit", "bag", "--out", "found", code=1).errors
        assert "Several publishers send the same joints at the same time: /joint_states#1" in said
        assert "such as `--topic '/joint_states#1'`" in said
        assert not (work / "found" / "recordings").exists()
        for number, offset in ((1, 0.0), (2, 0.15)):
            named = ("--topic", f"/joint_states#{number}")
            invoke("fit", "bag", *named, "--size", "0.16x0.12", "--out", "found", code=1)  # it shows no cloth
            log = read_raw_episode(work / "found" / "recordings" / "bag").robot
            late = 0.004 * (number - 1)
            np.testing.assert_allclose(log.joints_rad[:, 3], HOME_RAD[3] + 0.2 * (log.times - late) + offset, atol=1e-5)
            said = invoke("fit", "bag", "--topic", "/tf", "--out", "found", code=1).errors
            assert "or with other topics. Remove" in said
            shutil.rmtree(work / "found")
        said = invoke(*COMMAND, "--topic", "/tf", code=1).errors
        assert "--topic chooses among the topics of a ROS recording, and none was given" in said

    def test_of_damaged_notes(self, work):
        (work / "found").mkdir()
        (work / "found" / "cloth.yaml").write_text("[1, 2]")
        assert "must be a mapping" in invoke(*COMMAND, code=1).errors
        held = "grip: pad\ngrip_m: 0.02\n"
        whole = f"base: lift\nsize_m: [0.16, 0.12]\nnodes: [5, 5]\n{held}steps_per_frame: 8\nmaterial: denim\n"
        (work / "found" / "cloth.yaml").write_text(whole.replace("nodes: [5, 5]\n", ""))
        assert "cloth.yaml lacks nodes. Put it back, or remove the whole" in invoke(*COMMAND, code=1).errors
        (work / "found" / "cloth.yaml").write_text(whole.replace("lift", "vest_hang"))
        assert "cloth.yaml: size_m: unknown or unsupported field" in invoke(*COMMAND, code=1).errors
        (work / "found" / "cloth.yaml").write_text(whole)
        (work / "found" / "recordings.yaml").write_text("first: 3\n")
        said = invoke(*COMMAND, code=1).errors
        assert "recordings.yaml: first must be a mapping" in said
        assert "--size" not in said
        other = invoke(*COMMAND, "--size", "0.16x0.2", code=1).errors
        assert "cloth.yaml says size_m [0.16, 0.12], and that counts, not --size 0.16x0.2: edit the file" in other
        (work / "found" / "recordings.yaml").write_text("first: {yaw_deg: 10.0}\n")
        assert "recordings.yaml: first lacks center_m, initial_state, table_height_m" in invoke(*COMMAND, code=1).errors

    def test_two_of_one_name(self, work):
        twice = invoke("fit", "recorded/first", "recorded/first", "--out", "found", code=1)
        assert "Two recordings are named first" in twice.errors


UNFINISHED = ("report.html", "fit.json", "fit.npz", "cloth.yaml", "recordings.yaml")


def check_unfinished(out, told, status, why):
    """The report of a run that was stopped; the same command without the stop finishes it."""
    assert told["status"] == status
    assert told["findings"][0].startswith(f"Unfinished: {why}")
    assert all((out / name).is_file() for name in UNFINISHED)
    page = (out / "report.html").read_text()
    assert page.index('class="findings"') < page.index(f"Unfinished: {why}")
    assert 0.03 <= read_fit(out / "fit.json").free["stretching"] <= 30
    assert told["rms_mm"] > 0


class TestStopped:
    """By Ctrl-C or by the end of --budget, which are one."""

    def test_what_is_known_is_reported_and_the_next_run_finishes_it(self, work, monkeypatch):
        def stop(*given, **options):
            raise KeyboardInterrupt

        words = [*COMMAND, "--parameters", "stretching"]
        with monkeypatch.context() as patch:
            patch.setattr(task, "solve", stop)
            told = invoke(*words, code=130).result
        check_unfinished(Path("found"), told, "interrupted", "Ctrl-C was pressed")
        assert told["fits_to_noise"] is None
        assert told["parameters"]["stretching"]["low"] is None
        assert any("no intervals: the time was over" in line for line in told["findings"])
        assert not Path("found/intervals.json").exists()
        done = invoke(*words).result
        assert done["status"] == "finished"
        assert not any("Unfinished" in line for line in done["findings"])
        assert done["parameters"]["stretching"]["value"] == pytest.approx(10.0, rel=0.4)
        assert Path("found/intervals.json").is_file()
        assert "Unfinished" not in Path("found/report.html").read_text()

    def test_one_start_that_has_ended_has_an_interval(self, work, monkeypatch):
        """Ctrl-C during the second one."""
        whole = Descent.run

        def run(descent, to_beat):
            if to_beat < np.inf:
                raise KeyboardInterrupt
            return whole(descent, to_beat)

        with monkeypatch.context() as patch:
            patch.setattr(Descent, "run", run)
            told = invoke(*COMMAND, "--parameters", "stretching", "--starts", 2, code=130).result
        check_unfinished(Path("found"), told, "interrupted", "Ctrl-C was pressed")
        entry = told["parameters"]["stretching"]
        assert entry["low"] < entry["value"] < entry["high"]

    def test_a_budget_is_kept(self, work):
        began = time.monotonic()
        told = invoke(*COMMAND, "--parameters", "stretching", "--budget", "0.3s").result
        assert time.monotonic() - began < 60
        check_unfinished(Path("found"), told, "budget reached", "the time of --budget was over")

    def test_nonsense_is_refused_before_anything_is_written(self, work):
        refused = invoke(*COMMAND, "--budget", "soon", code=1)
        assert "--budget takes a time above 0" in refused.errors
        assert not Path("found").exists()

    @pytest.mark.longest  # with nothing beside it: it asks how soon the command ends
    @pytest.mark.parametrize("by", ["budget", "ctrl-c"])
    def test_a_towel_of_another_simulator_ends_soon_after_its_time(self, tmp_path, by):
        """Within 15 seconds. Without a budget, this takes about a minute with nothing beside it."""
        lifted_by_mujoco(tmp_path, "one", stretching=40.0)
        lifted_by_mujoco(tmp_path, "two", stretching=40.0, **OTHER)
        words = ["fit", "one", "two", "--size", "0.40x0.30", "--density", "0.25", "--out", "found", "--json"]
        words += ["--budget", "25s"] if by == "budget" else []
        began = time.monotonic()
        deaf = ["env", "--ignore-signal=INT"] if by == "budget" else []  # as a script starts it in the background
        command = [*deaf, *DIFFCLOUD, *words]
        with subprocess.Popen(command, cwd=tmp_path, env=environment(), stdout=subprocess.PIPE) as process:
            if by == "ctrl-c":
                time.sleep(25)
                process.send_signal(signal.SIGINT)
            out, _ = process.communicate(timeout=120)
        assert time.monotonic() - began < 40
        assert process.returncode == (0 if by == "budget" else 130)
        told = json.loads(out.decode().strip().splitlines()[-1])
        status = ("budget reached", "the time of --budget") if by == "budget" else ("interrupted", "Ctrl-C was pressed")
        check_unfinished(tmp_path / "found", told, *status)


class TestScene:
    def test_clouds_cut_above_all_that_lies_on_the_table_are_refused(self, work):
        for path in sorted(Path("recorded/first").glob("*.ply")):
            cloud = read_cloud(path)
            np.save(path.with_suffix(".npy"), cloud[cloud[:, 2] > 0.04])
            path.unlink()
        told = invoke("fit", "recorded/first", "--size", "0.16x0.12", "--out", "found", code=1).errors
        assert "2 of 9 clouds are empty (frames 0, 1)" in told
        assert not Path("found").exists()

    def test_a_rejected_size_changes_nothing_in_the_next_run(self, work):
        wrong = [*map(str, COMMAND)]
        wrong[wrong.index("0.16x0.12")] = "0.40x0.30"
        assert "0.400 x 0.300 m was stated" in invoke(*wrong, code=1).errors
        assert not Path("found/cloth.yaml").exists()
        assert not Path("found/recordings.yaml").exists()
        _, cloth, _ = find_scene([Path("recorded/first")], Path("found"), None, None)
        assert cloth["size_m"] == pytest.approx(SIZE, abs=0.005)

    def test_of_a_bag_of_clouds_is_that_of_their_folder(self, work, monkeypatch):
        """Seen from a camera, with poses of the tool at another rate; and `fit` without a tool says what is missing."""
        track = np.loadtxt("recorded/first/gripper.csv", delimiter=",", skiprows=1)
        monkeypatch.setattr(ros_clouds, "cloud", lambda number: read_cloud(Path(f"recorded/first/{number:03d}.ply")))
        monkeypatch.setattr(ros_clouds, "tool_at", lambda t: [np.interp(t, track[:, 0], axis) for axis in track.T[1:]])
        ros_clouds.CloudBag(work / "first").write(tool=lambda bag, t, place: bag.pose_stamped("/tool_pose", t, place))
        ros_clouds.CloudBag(work / "alone").write()
        episodes, cloth, layouts = find_scene([Path("first")], Path("found"), SIZE, 0.25)
        assert dc.load_recording("found/episodes/first.npz").frame_count == ros_clouds.FRAMES
        assert episodes["first"].meta["source"] == "ros recording first"
        _, from_folder, expected = find_scene([Path("recorded/first")], Path("other"), SIZE, 0.25)
        assert cloth == from_folder
        same = ("yaw_deg", "grasped", "center_m", "table_height_m")
        assert [layouts["first"][key] for key in same] == [expected["first"][key] for key in same]
        said = invoke("fit", "alone", "--out", "third", code=1).errors
        assert "The tool's pose is unknown: there is no topic of poses" in said
        assert "The recording has no track of its gripper" in said
        assert not Path("third/cloth.yaml").exists()

    @pytest.mark.parametrize("sides", [(1.0, 1.0), (0.22, 0.18)])
    @pytest.mark.parametrize("stated", [None, "as the table"])
    def test_clouds_with_the_table_are_refused(self, work, sides, stated):
        rng, folder = np.random.default_rng(3), Path("recorded/first")
        count = round(1e5 * sides[0] * sides[1])
        for path in folder.glob("*.ply"):
            table = np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)) * sides + (0.5, 0.0), np.full(count, 0.02)])
            write_ply(path, np.concatenate([read_cloud(path), table + 0.002 * rng.standard_normal(table.shape)]))
        with pytest.raises(EpisodeError, match=r"seem to hold the table.*Only points of the cloth.*Remove the table"):
            find_scene([folder], Path("found"), None if stated is None else sides, None)
        assert not Path("found/cloth.yaml").exists()


def lifted_by_mujoco(folder, name, *, stretching, yaw=0.0, centre=(0.55, 0.0), cut_m=-np.inf):
    """Clouds with two millimetres of noise of a towel of 25 x 19 nodes that a pad of 17 mm holds, those above the table by
    more than `cut_m`."""
    pytest.importorskip("mujoco")
    from diffcloud.mesh.shapes import grid_cloth
    from diffcloud.sim.motion import Keyframe, Motion
    from diffcloud.simulators import mujoco
    from diffcloud.simulators.problem import Problem, Sheet

    sheet = Sheet(density=0.25, stretching=stretching, poisson=0.3, bending=1e-5, damping=0.005)
    path = Motion((Keyframe(0.0, (0.0, 0.0, 0.0)), Keyframe(2.5, (-0.1, -0.1, 0.45))))
    mesh = grid_cloth(19, 25, 0.30, 0.40)
    c, s = np.cos(yaw), np.sin(yaw)
    nodes = mesh.nodes @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + np.array([*centre, 0.022])
    pad = [25 * row + column for row in (17, 18) for column in (23, 24)]
    problem = Problem("lift", replace(mesh, nodes=nodes), sheet, 1.5, dict.fromkeys(pad, path), table=0.02)
    settings, sheet = mujoco.stable(problem)
    run = mujoco.simulate(replace(problem, sheet=sheet), settings)
    sampler = SurfaceSampler.build(torch.as_tensor(mesh.faces), 3000, generator=torch.Generator().manual_seed(1))
    rng = np.random.default_rng(1)
    (folder / name).mkdir()
    for index, cloud in enumerate(sampler.sample(torch.as_tensor(run.nodes)).numpy()):
        noisy = cloud + 0.002 * rng.standard_normal(cloud.shape)
        np.save(folder / name / f"{index:03d}.npy", noisy[noisy[:, 2] > 0.02 + cut_m])
    track = np.column_stack([problem.times, run.nodes[:, pad].mean(1)])
    np.savetxt(folder / name / "gripper.csv", track, delimiter=",", header="t_s,x,y,z", comments="")


OTHER = {"yaw": 0.44, "centre": (0.57, -0.05)}
"""How the towel lies the second time."""


def towel_identified(folder, *recordings):
    with contextlib.chdir(folder):
        return invoke("fit", *recordings, "--size", "0.40x0.30", "--density", 0.25, "--out", "found").result


@pytest.fixture(scope="module")
def stiff(tmp_path_factory):
    """Of two lifts of the stiff one, what is found."""
    folder = tmp_path_factory.mktemp("stiff")
    lifted_by_mujoco(folder, "one", stretching=40.0)
    lifted_by_mujoco(folder, "two", stretching=40.0, **OTHER)
    return towel_identified(folder, "one", "two")


class TestTowelOfAnotherSimulator:
    """MuJoCo lifts it, of 40 or 10 N/m; its weight is known. The notebook's test fits another in less time."""

    @pytest.mark.longest
    def test_stiff_in_two_recordings(self, stiff):
        assert stiff["parameters"]["stretching"]["value"] == pytest.approx(40, rel=0.1)
        assert stiff["rms_mm"] < 4
        assert stiff["held_out"].startswith("The parameters predict other recordings of this motion")

    @pytest.mark.longest
    def test_its_interval_holds_the_truth(self, stiff):
        told = stiff["parameters"]["stretching"]
        assert told["low"] < 40 < told["high"]

    @pytest.mark.longest
    def test_soft_in_one_recording(self, tmp_path):
        lifted_by_mujoco(tmp_path, "soft", stretching=10.0)
        found = towel_identified(tmp_path, "soft")
        told = found["parameters"]["stretching"]
        assert 10 / 1.5 < told["value"] < 10 * 1.5
        assert told["low"] < 10 < told["high"]
        assert found["rms_mm"] < 8

    @pytest.mark.longest
    def test_cut_a_little_above_the_table(self, tmp_path):
        lifted_by_mujoco(tmp_path, "one", stretching=40.0, cut_m=0.005)
        lifted_by_mujoco(tmp_path, "two", stretching=40.0, cut_m=0.005, **OTHER)
        told = towel_identified(tmp_path, "one", "two")["parameters"]["stretching"]
        assert 40 / 1.5 < told["value"] < 40 * 1.5
        assert told["low"] < 40 < told["high"]


@pytest.mark.longest
def test_how_long_it_takes_is_measured():
    told = study("bench", "--fit", "--threads", 1)
    assert told.result["threads"] == 1
    assert told.result["fit_seconds"] > 0


def test_results_are_plain_json(found):
    folder, _ = found
    told = json.loads((folder / "found" / "intervals.json").read_text())
    assert told["parameters"]["stretching"]["status"]


@pytest.fixture
def project(found, tmp_path):
    """A copy of what was found, made a project."""
    shutil.copytree(found[0] / "found", tmp_path / "found")
    for page in ("params.yaml", "dvc.yaml"):
        (tmp_path / "found" / page).unlink(missing_ok=True)
    make_project(tmp_path / "found", ["--parameters", "stretching", "--density", "0.25"])
    return tmp_path / "found"


def dvc(folder, *words):
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    done = subprocess.run(
        [sys.executable, "-m", "dvc", *words], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


class TestProject:
    """`diffcloud fit --dvc`."""

    @pytest.mark.slow
    def test_the_pipeline_comes_to_the_same_fit_and_runs_again_only_for_what_changed(self, project):
        before = read_fit(project / "fit.json")
        assert (
            yaml.safe_load((project / "params.yaml").read_text())["fit"]["options"]
            == "--parameters stretching --density 0.25"
        )
        dvc(project, "repro", "fit")
        assert read_fit(project / "fit.json").fingerprint == before.fingerprint  # the finished fit was kept
        assert "up to date" in dvc(project, "status", "fit")
        assert "stretching" in dvc(project, "metrics", "show")
        (project / "episodes" / "second.npz").rename(project / "elsewhere.npz")
        assert "episodes" in dvc(project, "status", "fit")
        dvc(project, "repro", "fit")
        assert [one.name for one in read_fit(project / "fit.json").episodes] == ["first"]
        assert "up to date" in dvc(project, "status", "fit")

    def test_it_depends_on_the_mesh_of_the_cloth(self, project):
        for page in ("params.yaml", "dvc.yaml"):
            (project / page).unlink()
        (project / "cloth.obj").write_text("v 0 0 0\n")
        make_project(project, [])
        assert "cloth.obj" in yaml.safe_load((project / "dvc.yaml").read_text())["stages"]["fit"]["deps"]

    def test_what_was_typed_is_kept(self, project):
        """But the recordings and what was found in them. A path is relative to the project."""
        (project.parent / "my settings.yaml").write_text("fit: {seed: 3}\n")
        for page in ("params.yaml", "dvc.yaml"):
            (project / page).unlink()
        typed = ("--parameters", "stretching", "--starts", "1", "--max-steps", "1", "--bound", "stretching=1:100")
        typed += ("--init", "stretching=9", "--alignment", "x=1cm", "--budget", "none")
        given = ("--params", "my settings.yaml", "--size", "0.16x0.12", "--density", "0.25", "--dvc", "--out", "found")
        with contextlib.chdir(project.parent):
            invoke("fit", "found/episodes/first.npz", *typed, *given)
        options = yaml.safe_load((project / "params.yaml").read_text())["fit"]["options"]
        assert sorted(shlex.split(options)) == sorted([*typed, "--params", "../my settings.yaml", "--density", "0.25"])
        stages = yaml.safe_load((project / "dvc.yaml").read_text())["stages"]
        assert stages["fit"]["deps"] == ["episodes", "cloth.yaml", "recordings.yaml", "../my settings.yaml"]

    def test_its_stages_are_commands_that_exist(self, project):
        check_commands(yaml.safe_load((project / "dvc.yaml").read_text())["stages"])

    def test_dvc_knows_it_inside_of_a_repository_and_outside(self, project):
        told = dvc(project, "status")
        assert "fit" in told
        inner = project / "inner"
        shutil.copytree(project, inner, ignore=shutil.ignore_patterns(".dvc*", "*.yaml", "inner"))
        for name in ("cloth.yaml", "recordings.yaml"):
            shutil.copy(project / name, inner / name)
        make_project(inner, [])
        assert not (inner / ".dvc").exists()  # the outer project's

    def test_nothing_is_written_over(self, project):
        options = ["--parameters", "stretching", "--density", "0.25"]
        make_project(project, options)  # the same once more is no change
        (project / "params.yaml").write_text("mine: 1\n")
        with pytest.raises(ConfigError, match=r"params\.yaml is there already"):
            make_project(project, options)
        assert (project / "params.yaml").read_text() == "mine: 1\n"

    def test_a_folder_where_no_fit_has_finished_is_refused(self, project, tmp_path):
        with pytest.raises(ConfigError, match=r"lacks cloth\.yaml, recordings\.yaml, fit\.json"):
            make_project(tmp_path, [])
        for name in ("params.yaml", "dvc.yaml", "episodes/first.npz"):
            (project / name).unlink()
        with pytest.raises(ConfigError, match="lacks first"):
            make_project(project, [])
        assert not (project / "dvc.yaml").exists()

    def test_a_damaged_fit_is_named_and_nothing_is_written(self, project):
        for page in ("params.yaml", "dvc.yaml"):
            (project / page).unlink()
        (project / "fit.json").write_text("{}")
        with pytest.raises(ConfigError, match=r"fit\.json"):
            make_project(project, [])
        assert not (project / "dvc.yaml").exists()


@pytest.mark.parametrize("name", ["towel", "001", "2024-06-01", "on", "null", "a: b", "a # b", "'", "x" * 200])
def test_a_recording_may_have_any_name(name):
    """Among the keys of recordings.yaml, where a number, a date or a word of YAML would be no name."""
    assert yaml.safe_load(f"{scene_files._inline(name)}:\n  a: 1") == {name: {"a": 1}}


@pytest.mark.slow
def test_the_library_finds_the_same(work):
    """From the same folders to the last bit of the fit."""
    told = invoke(*COMMAND, *QUICK).result
    recordings = [dc.load_recording(Path("recorded") / name) for name in ("first", "second")]
    scenes = dc.find_scenes(recordings, size=SIZE, density=0.25)
    solver = LikelihoodSolver(starts=1)
    settings = scenes[0].settings.model_copy(update={"parameters": ["stretching"], "solver": solver})
    found = dc.fit(recordings, scenes, settings)
    entry, estimate = told["parameters"]["stretching"], found.parameters["stretching"]
    assert (estimate.value, *estimate.interval) == (entry["value"], entry["low"], entry["high"])
    assert [one.left_out.rms_mm for one in found.record.episodes] == [
        one.left_out.rms_mm for one in read_fit(Path("found/fit.json")).episodes
    ]
