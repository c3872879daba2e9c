"""Files of weights: round trip, and what a damaged one says."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from diffcloud.errors import CheckpointError, EpisodeError
from diffcloud.io.episodes import Episode
from diffcloud.regressors import MODEL_NAMES, Description, Regressor, frames_seen, predict_episode
from diffcloud.regressors.checkpoints import OutputScale, Prediction, laplace_reach


def regressor(model="mlp", **changes):
    torch.manual_seed(0)
    told = Description(
        **{
            "model": model,
            "scenario": "lift",
            "names": ("stretching", "density"),
            "bounds": ((0.1, 10.0), (0.1, 10.0)),
            "times": (0.3, 0.4, 0.5) if frames_seen(model) == "all" else (0.5,),
            "frame_time": 0.1,
            "points": 30,
            "centre": (0.1, 0.2, 0.3),
            "length": 2.0,
            "order": "nearest",
            "density": 0.125,
            "spread": (0.1, 0.2),
            **changes,
        }
    )
    return Regressor(told, told.build().eval())


def episode(frames=6, points=50, seed=0):
    generator = torch.Generator().manual_seed(seed)
    clouds = [torch.rand(points, 3, generator=generator).numpy() for _ in range(frames)]
    return Episode.from_frames(clouds, torch.arange(frames).double().mul(0.1).numpy())


@pytest.mark.parametrize("model", MODEL_NAMES)
@pytest.mark.parametrize("predict_variance", [False, True])
def test_a_regressor_comes_back_as_it_was(tmp_path, model, predict_variance):
    first = regressor(model, predict_variance=predict_variance and model != "posterior")
    first.write(tmp_path / "a.safetensors")
    second = Regressor.read(tmp_path / "a.safetensors")
    assert second.description == first.description
    a, b = predict_episode(first, episode()), predict_episode(second, episode())
    assert torch.equal(a.values, b.values)
    assert torch.equal(a.width, b.width)
    second.write(tmp_path / "b.safetensors")
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()


def test_frames_are_found_by_time(tmp_path):
    """A recording at twice the rate that begins later gives the same prediction as the frames of the training."""
    one = regressor("meteornet")
    whole = episode(frames=6, points=30)  # as many as the network takes: the choice of points is a permutation
    frames = [whole.frame(index) for index in range(6)]
    quick = Episode.from_frames(
        [frame for frame in frames[2:] for _ in (0, 1)], torch.arange(4, 12).double().mul(0.05).numpy()
    )
    torch.testing.assert_close(predict_episode(one, quick).values, predict_episode(one, whole).values, atol=1e-5, rtol=0)
    with pytest.raises(EpisodeError, match=r"looks at 0.5 s, but the episode's 4 frames run from 0 to 0.3 s"):
        predict_episode(one, Episode.from_frames(frames[:4], whole.times[:4]))


@pytest.mark.parametrize("points", [12, 30, 5000])
def test_the_library_predicts_from_clouds_what_the_command_predicts_from_their_episode(points):
    one, whole = regressor("pointnet2"), episode(points=points)
    expected = predict_episode(one, whole).values
    assert torch.equal(one.predict([[whole.frame(5)]]).values, expected)
    assert torch.equal(one.predict(torch.from_numpy(whole.frame(5))[None, None]).values, expected)


def test_clouds_that_are_none_are_refused():
    cloud = np.zeros((50, 3))
    for wrong in ([cloud, cloud], [], [np.zeros((0, 3))], [np.zeros((50, 2))], [cloud * np.nan]):
        with pytest.raises(EpisodeError, match=r"looks at 1 frames|Cloud 0 has shape"):
            regressor().predict([wrong])


def test_clouds_of_any_size_are_taken():
    for points in (3, 5000):
        assert predict_episode(regressor(), episode(points=points)).values.shape == (1, 2)


def test_values_outside_are_told_and_clipped_only_for_a_simulation():
    scale = OutputScale(torch.tensor([[0.1, 10.0], [1.0, 3.0]]), "linear")
    fractions = torch.tensor([[0.5, 1.25]])
    found = Prediction(("stretching", "density"), scale.values(fractions), fractions, torch.ones(1, 2), scale)
    torch.testing.assert_close(found.values, torch.tensor([[5.05, 3.5]]))
    assert found.inside.tolist() == [[True, False]]
    torch.testing.assert_close(found.clipped, torch.tensor([[5.05, 3.0]]))


@pytest.mark.parametrize("target", ["linear", "logarithmic"])
def test_scales_go_there_and_back(target):
    scale = OutputScale(torch.tensor([[0.1, 10.0], [1.0, 3.0]]), target)
    linear = torch.rand(5, 2)
    low, high = scale.bounds.unbind(-1)
    torch.testing.assert_close(scale.values(scale.from_linear(linear)), low + (high - low) * linear)
    assert scale.values(torch.zeros(2)).tolist() == pytest.approx([0.1, 1.0])
    assert scale.values(torch.ones(2)).tolist() == pytest.approx([10.0, 3.0])


def test_intervals_of_a_laplace_distribution_hold_what_they_say():
    draws = torch.distributions.Laplace(0.0, 2.0).sample((100_000,))
    for level in (0.1, 0.5, 0.9):
        assert float((draws.abs() <= 2.0 * laplace_reach(level)).float().mean()) == pytest.approx(level, abs=0.01)


def damaged(path, change):
    """Write a good checkpoint, changed."""
    regressor().write(path)
    tensors = load_file(path)
    described = json.loads(regressor().description.model_dump_json())
    change(tensors, described)
    save_file(tensors, path, metadata={"diffcloud": json.dumps(described)})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda tensors, _: tensors.pop("head.0.norm.weight"), "head.0.norm.weight is missing or too much"),
        (lambda tensors, _: tensors.update({"points.0.linear.weight": torch.zeros(64, 4)}), r"must be .* \[64, 3\], got"),
        (lambda tensors, _: tensors["points.0.linear.bias"].fill_(float("nan")), "holds NaN"),
        (lambda _, told: told.update(model="resnet"), "model: Input should be 'mlp'"),
        (lambda _, told: told.update(points=10**9), "points: Input should be less than or equal to 1000000"),
        (lambda _, told: told.update(spread=[1.0]), "2 names need as many bounds and spreads"),
        (lambda _, told: told.update(bounds=[[1, 0], [0, 1]]), "bounds of stretching must be in order"),
        (lambda _, told: told.update(extra=1), "extra: Extra inputs are not permitted"),
        (lambda _, told: told.update(model="posterior", predict_variance=True), "a posterior has widths of its own"),
    ],
)  # fmt: skip
def test_a_changed_file_is_refused_by_field(tmp_path, change, message):
    damaged(tmp_path / "a.safetensors", change)
    with pytest.raises(CheckpointError, match=message):
        Regressor.read(tmp_path / "a.safetensors")


def test_other_files_are_refused(tmp_path):
    path = tmp_path / "a.safetensors"
    with pytest.raises(CheckpointError, match="No such checkpoint"):
        Regressor.read(path)
    regressor().write(path)
    whole = path.read_bytes()
    for content in (b"", b"nothing", whole[:1000], whole[:-10], b"\xff" * 100):
        path.write_bytes(content)
        with pytest.raises(CheckpointError, match="not a readable checkpoint"):
            Regressor.read(path)
    torch.save({"model": 1}, path)
    with pytest.raises(CheckpointError, match="not a readable checkpoint"):
        Regressor.read(path)
    save_file({"x": torch.zeros(1)}, path)
    with pytest.raises(CheckpointError, match="lacks the description"):
        Regressor.read(path)


WALL = {"nodes": ((2.0, -9, -9), (2.0, 9, -9), (2.0, 0, 9)), "faces": ((0, 1, 2),), "reach": 0.1}


@pytest.mark.parametrize("model", [name for name in MODEL_NAMES if name != "posterior"])  # which sees as MeteorNet does
def test_what_is_background_changes_no_prediction(tmp_path, model):
    knowing = regressor(model, background=WALL)
    knowing.write(tmp_path / "a.safetensors")
    knowing = Regressor.read(tmp_path / "a.safetensors")
    plain = episode(points=30)
    frames = [plain.frame(index) for index in range(plain.frame_count)]
    wall = np.random.default_rng(0).uniform(-1, 1, (70, 3)).astype(np.float32)
    wall[:, 0] = 2.05
    walled = Episode.from_frames([np.concatenate([wall, frame]) for frame in frames], plain.times)
    expected = predict_episode(knowing, plain).values
    torch.testing.assert_close(predict_episode(knowing, walled).values, expected, rtol=0, atol=1e-5)
    assert not torch.allclose(predict_episode(regressor(model), walled).values, expected, rtol=0, atol=1e-4)


def test_a_background_of_missing_nodes_is_refused(tmp_path):
    regressor(background=WALL).write(tmp_path / "a.safetensors")
    metadata = {"diffcloud": json.dumps({**regressor(background=WALL).description.model_dump(), "background": {
        **WALL, "faces": ((0, 1, 3),)}})}  # fmt: skip
    save_file(load_file(tmp_path / "a.safetensors"), tmp_path / "b.safetensors", metadata=metadata)
    with pytest.raises(CheckpointError, match="background: Value error, faces must name nodes 0 to 2"):
        Regressor.read(tmp_path / "b.safetensors")
