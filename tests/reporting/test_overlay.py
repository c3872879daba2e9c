"""What is drawn: which points, of which camera, when; and a browser that draws it."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.axes import Axes

from diffcloud.estimation.pose import PoseSpace
from diffcloud.estimation.result import recorded_pose
from diffcloud.io.episodes import Episode
from diffcloud.reporting.figures import overlay_figure
from diffcloud.reporting.overlay import Layer, Overlay, held_layers, recorded_layers, states_at
from diffcloud.reporting.view import build_view, scene_layers, unposed_layer
from diffcloud.scene.scenarios import load_scenario
from tests.estimation.records import recording_of
from tests.reporting.pages import entry, overlays_of, page_of

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
NASTY = "<!--<script>alert(1)</script>"


def drawn(episode, frames=(0, 1), points=1000):
    layers = recorded_layers(episode, frames, points=points, rng=np.random.default_rng(0))
    return {(layer.name, layer.kind): layer for layer in layers}


@pytest.fixture
def two_cameras():
    rng = np.random.default_rng(1)
    return replace(
        Episode.from_frames(
            [rng.random((50, 3)), rng.random((70, 3))], np.array([0.0, 0.1]), gripper=rng.random((2, 1, 3))
        ),
        camera=(np.arange(120) % 3 == 0).astype(np.uint8),
        meta={"cameras": ["overhead", "side"], "viewpoints": {"overhead": [0, 0, 1.0], "side": [1.0, 0, 0.5]}},
    )


class TestRecorded:
    def test_each_camera_has_its_points_and_none_is_lost(self, two_cameras):
        found = drawn(two_cameras)
        for frame in range(2):
            both = [found[f"recorded, {name}", "points"].frames[frame] for name in ("overhead", "side")]
            assert len(both[1]) == two_cameras.camera[two_cameras.offsets[frame] : two_cameras.offsets[frame + 1]].sum()
            together = np.concatenate(both)
            assert {tuple(row) for row in together} == {tuple(row) for row in two_cameras.frame(frame)}

    def test_no_more_points_than_asked_for(self, two_cameras):
        found = drawn(two_cameras, points=20)
        assert sum(len(layer.frames[0]) for (_, kind), layer in found.items() if kind == "points") == 20

    def test_gripper_path_and_cameras(self, two_cameras):
        found = drawn(two_cameras, frames=[1])
        np.testing.assert_array_equal(found["gripper, as recorded", "marks"].frames[0], two_cameras.gripper[1])
        np.testing.assert_array_equal(found["gripper, as recorded", "line"].frames[0], two_cameras.gripper[:, 0])
        assert found["cameras", "marks"].labels == ("overhead", "side")

    @pytest.mark.parametrize("names", [None, "overhead", ["overhead"], 3])
    def test_names_that_do_not_fit_the_points_leave_one_cloud(self, two_cameras, names):
        found = drawn(replace(two_cameras, meta={"cameras": names}))
        assert len(found["recorded", "points"].frames[0]) == 50


def test_the_cloth_follows_the_recorded_gripper():
    scenario = load_scenario("lift")
    times = np.array([0.0, 0.2, 0.4])
    gripper = np.array([[[0.0, 0, 0]], [[0, 0, 0.05]], [[0, 0, 0.1]]])
    episode = Episode.from_frames([np.zeros((1, 3))] * 3, times, gripper=gripper)
    layers = scene_layers(scenario, episode, times)
    named = {layer.name: layer for layer in layers}
    cloth = np.asarray(named["cloth, nominal material"].frames)
    held = cloth[:, scenario.scene.handles.nodes]
    np.testing.assert_allclose(held[..., 2] - held[0, :, 2], [[0.0] * 4, [0.05] * 4, [0.1] * 4], atol=1e-3)  # of a pad
    paths = [layer.frames[0] for layer in layers if (layer.name, layer.kind) == ("held nodes", "line")]
    np.testing.assert_array_equal(paths, np.moveaxis(held, 1, 0))
    assert np.ptp(named["table"].frames[0][:, 2]) == 0


def displaced_fold(compared=(1, 2, 3, 4), residuals=(5.0, 9.0, 7.0, 6.0)):
    """A fit of four frames whose recorded gripper is a point 71 mm above the node that it holds."""
    one = entry(scenario="fold")
    frames = np.arange(5)
    nodes = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]]) + 0.1 * frames[:, None, None]
    times = 0.1 * frames
    gripper = nodes[:, 1:2] + [0, 0, 0.071]
    motion = replace(one.motion, nodes=nodes, start_nodes=nodes, times=times, held=np.array([1]))
    episode = Episode.from_frames([np.zeros((4, 3))] * 5, times, gripper=gripper)
    recording = one.recording.model_copy(update={"frames": list(compared), "frame_rms_mm": list(residuals)})
    return replace(one, episode=episode, motion=motion, recording=recording)


class TestShown:
    """What the report shows of a fit first."""

    def test_the_marker_lies_on_the_cloth_in_every_frame(self):
        (told,) = overlays_of(page_of(displaced_fold()))
        layers = {(layer["name"], layer["kind"]): layer for layer in told["layers"]}
        cloth, marks = (np.array(layers[key]["frames"]) for key in (("fitted", "mesh"), ("held nodes", "marks")))
        assert len(marks) == 5
        np.testing.assert_array_equal(marks[:, :, 0], cloth[:, :, 1])
        (path,) = layers["held nodes", "line"]["frames"]
        np.testing.assert_array_equal(np.transpose(path), cloth[:, :, 1])
        assert not layers["gripper, as recorded", "marks"]["shown"]

    @pytest.mark.parametrize(("compared", "residuals", "shown"), [((1, 2, 3, 4), (5, 9, 7, 6), 2), ((3, 4), (1, 2), 4)])
    def test_the_frame_with_the_largest_residual_is_shown(self, compared, residuals, shown):
        one = displaced_fold(compared, residuals)
        (told,) = overlays_of(page_of(one))
        assert told["opens"] == one.shown_frame == shown
        assert told["residuals"] == [dict(zip(compared, residuals, strict=True)).get(frame) for frame in range(5)]

    def test_the_figure_has_the_same_frame(self, monkeypatch):
        one, drawn = displaced_fold(), []
        monkeypatch.setattr(Axes, "triplot", lambda _, x, z, *args, **options: drawn.append(z))
        overlay_figure([one])
        np.testing.assert_allclose(drawn, [one.motion.nodes[2, :, 2]] * 2)


def test_a_cloth_that_nothing_holds_has_no_marker():
    assert held_layers(np.zeros((2, 3, 3)), np.zeros(0, dtype=np.int64)) == []


def test_without_its_pose_the_cloth_lies_where_the_scene_has_it():
    """The pose of the record, applied to what is drawn, gives the fitted motion again."""
    told = {"x": {"value": 0.21, "prior": 0.1, "unit": "m"}, "yaw": {"value": 0.4, "prior": 0.5, "unit": "rad"}}
    recording, motion = recording_of("tan1", scenario="lift", nuisance=told), entry().motion
    scenario = load_scenario("lift")
    layer = unposed_layer(scenario, recording, motion, motion.times)
    space, pose = recorded_pose(recording, length_unit_m=scenario.length_unit_m)
    assert isinstance(space, PoseSpace)
    again = space.moved(pose.new_tensor(np.asarray(layer.frames))[None], pose)[0]
    np.testing.assert_allclose(again, motion.nodes, atol=1e-12)
    assert np.abs(np.asarray(layer.frames) - motion.nodes).max() > 0.1


def test_states_are_the_nearest_in_time():
    assert states_at(np.array([0.0, 0.1, 0.2]), np.array([0.04, 0.06, 9.0])).tolist() == [0, 1, 2]


def view_of(name="a"):
    cloud, other = np.zeros((4, 3)), np.ones((5, 3))
    layers = [Layer("recorded", "points", [cloud, other], "target"), Layer("hidden", "marks", [cloud], "soft", shown=False)]
    one = Overlay(name, [3, 7], np.array([0.1, 0.4]), layers, photographs=[b"1", b"2"])
    return build_view([one], title=name, note="", facts=[(name, name)])


def test_names_are_text_and_cannot_end_the_script():
    page = view_of(NASTY)
    assert NASTY not in page
    (told,) = re.findall(r"const overlays = (.*);", page)
    assert json.loads(told)[0]["name"] == NASTY


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on PATH: the pages are not drawn")
class TestBrowser:
    """A script at the end of the page uses it as a person would, and writes down what it sees."""

    def seen(self, tmp_path, page, script):
        # the page's own errors end before this, so that nothing is written down
        note = "const pre = document.createElement('pre'); pre.id = 'seen'; pre.textContent = JSON.stringify(seen);"
        told = f"{page}<script>const seen = (() => {{ {script} }})(); {note} document.body.append(pre);</script>"
        (tmp_path / "page.html").write_text(told, encoding="utf-8")
        options = ("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking")
        options += (
            "--use-angle=swiftshader",
            "--enable-unsafe-swiftshader",
            "--disable-component-update",
            "--disable-sync",
        )
        command = [CHROMIUM, *options, f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom"]
        done = subprocess.run(
            [*command, (tmp_path / "page.html").as_uri()], capture_output=True, text=True, timeout=120, check=True
        )
        (written,) = re.findall(r'<pre id="seen">(.*?)</pre>', done.stdout)
        return json.loads(written)

    def test_slider_boxes_and_photographs(self, tmp_path):
        script = """
          const told = [byId("time").textContent, byId("scene").data[0].x.length, byId("scene").data[1].visible];
          slider.value = 1; slider.oninput();
          byId("layers").querySelectorAll("input")[1].click();
          return [...told, byId("time").textContent, byId("scene").data[0].x.length, byId("scene").data[1].visible,
            byId("photograph").hidden, [...document.querySelectorAll("select, button, input, img")].every(e =>
              e.getAttribute("aria-label") || e.textContent || e.alt || e.labels.length)];
        """
        found = self.seen(tmp_path, view_of(), script)
        assert found == ["frame 3, 0.10 s", 4, False, "frame 7, 0.40 s", 5, True, False, True]

    def test_the_report_draws_its_cloth_and_its_curves(self, tmp_path):
        script = (
            "document.querySelectorAll('details').forEach(one => { one.open = true; }); plots();"
            "return [byId('scene').data.map(one => one.type), byId('curves').data.length, pick.options.length]"
        )
        found = self.seen(tmp_path, page_of(entry("one"), entry("two")), script)
        assert found == [["scatter3d", "mesh3d", "mesh3d", "scatter3d", "scatter3d"], 2, 2]
