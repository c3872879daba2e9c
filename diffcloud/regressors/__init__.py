"""Inverse models: networks that predict simulator parameters from point clouds (paper, section IV-B). `training` is not
imported here, because it imports Lightning, which predictions do not need."""

from diffcloud.regressors.checkpoints import Description, Prediction, Regressor
from diffcloud.regressors.dataset import Augmentation, CloudDataset, SimulatedSet
from diffcloud.regressors.networks import MODEL_NAMES, ModelName, build_network, frames_seen, layer_sizes
from diffcloud.regressors.predict import predict_episode, recorded_frames
from diffcloud.regressors.settings import PROFILE_NAMES, TrainingSettings, profile_settings

__all__ = [
    "MODEL_NAMES",
    "PROFILE_NAMES",
    "Augmentation",
    "CloudDataset",
    "Description",
    "ModelName",
    "Prediction",
    "Regressor",
    "SimulatedSet",
    "TrainingSettings",
    "build_network",
    "frames_seen",
    "layer_sizes",
    "predict_episode",
    "profile_settings",
    "recorded_frames",
]
