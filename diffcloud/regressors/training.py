"""Training of a regressor with Lightning: L1 loss, Adam, best weights by validation (paper, section IV-B).

The test set is divided. The first part chooses the best epoch and the widths of the intervals. The rest is held out and
only evaluated. A training is a function of its settings and data: the random numbers of every epoch come from (seed,
epoch). So a training that was interrupted and resumed gives the same result.
"""

from __future__ import annotations

import hashlib
import logging
import math
import pickle
import signal
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import lightning.pytorch as lightning
import numpy as np
import torch
from lightning.fabric.utilities.warnings import PossibleUserWarning
from lightning.pytorch.callbacks import EarlyStopping
from scipy.stats import kstest
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset, Sampler

from diffcloud.errors import ConfigError, TrainingError
from diffcloud.io.files import together, write_bytes, write_json
from diffcloud.io.timings import write_timings
from diffcloud.regressors.checkpoints import (
    BackgroundBody,
    Description,
    OutputScale,
    Regressor,
    split_outputs,
)
from diffcloud.regressors.dataset import Augmentation, CloudDataset, SimulatedSet
from diffcloud.regressors.networks import ModelName, frames_seen
from diffcloud.regressors.posterior import Posterior
from diffcloud.regressors.settings import BACKGROUND_REACH_M, Loss, TrainingSettings

Device = Literal["auto", "cpu", "gpu"]
LEVELS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
"""Probabilities of the intervals whose coverage is checked."""
_VALIDATION = 0.4
"""Fraction of the test set for validation. Of the paper's 375 samples, 225 are left for the evaluation."""
_SCALE_SAMPLES = 64
"""Number of training clouds from which the centre and the length are computed."""
_SAVE_EVERY_S = 10.0


@dataclass(frozen=True)
class TrainingProgress:
    """Progress after each epoch."""

    epoch: int
    """Number of completed epochs."""
    train_loss: float
    validation_loss: float
    best: float


@dataclass(frozen=True)
class TrainingResult:
    """Result of a training."""

    regressor: Regressor
    summary: dict[str, Any]
    """Settings, history, held-out errors and calibration, written beside the checkpoint."""
    seconds: float
    resumed_from: int
    """Number of epochs that an interrupted run had completed."""


def train_regressor(
    model: ModelName,
    train: SimulatedSet,
    test: SimulatedSet,
    settings: TrainingSettings,
    out: Path,
    *,
    device: Device = "auto",
    workers: int = 0,
    mark: str = "",
    progress: Callable[[TrainingProgress], None] | None = None,
) -> TrainingResult:
    """Train, evaluate the best weights on held-out samples, and write the results.

    It writes `out` (the checkpoint) and a folder of the same name without suffix, together with the wall time
    (`io.timings`). The folder has `training.json` and DVCLive's metrics of each epoch. Until the end, a hidden file
    beside `out` has the state after the last saved epoch. The same call resumes from this state.

    Args:
        workers: number of CPU processes that sample clouds. With 0, clouds are sampled on the training device.
        mark: fingerprint of data, settings and code. It is stored with the result, and only a state with the same mark
            is resumed.

    Raises:
        ConfigError: the sets do not belong together or are too small.
        TrainingError: the loss is not finite, or metrics cannot be written.
        KeyboardInterrupt: Ctrl-C; the same call resumes from the last saved epoch.
    """
    began = time.perf_counter()
    if device == "gpu" and not (torch.cuda.is_available() or torch.backends.mps.is_available()):
        raise ConfigError(
            "Torch finds no GPU on this machine. Use --device cpu, or --device auto, which uses a GPU if there is one."
        )
    _check_sets(train, test, settings)
    if model == "posterior" and (settings.predict_variance or settings.loss != "normalised"):
        raise ConfigError(
            "The model posterior has its own loss and predicts its own widths. Remove predict_variance and loss: raw."
        )
    if settings.predict_variance and settings.loss == "raw" and settings.target == "logarithmic":
        raise ConfigError(
            "With predict_variance and loss: raw, widths are learned in the parameters' units, but those of a logarithmic "
            "target are on its scale. Use target: linear, or loss: normalised."
        )
    on_gpu = device == "gpu" or (device == "auto" and torch.cuda.is_available())
    place = torch.device("cuda" if on_gpu and torch.cuda.is_available() else "cpu")
    clouds = _Clouds.build(model, train, test, settings, device=torch.device("cpu") if workers else place)
    centre, length = _centre_and_length(clouds.train)
    told = Description(
        model=model,
        scenario=train.scenario,
        names=train.names,
        bounds=tuple((float(low), float(high)) for low, high in train.bounds),
        target=settings.target,
        predict_variance=settings.predict_variance,
        times=tuple(clouds.train.times.tolist()),
        frame_time=float(np.diff(train.times).min()),
        points=settings.points,
        centre=centre,
        length=length,
        length_unit_m=train.length_unit_m,
        background=clouds.background,
        order=settings.order,
        density=settings.density,
        spread=(1.0,) * len(train.names),
        training={"settings": asdict(settings), "draws": clouds.draws},
    )
    torch.manual_seed(settings.seed)
    module = _Training(told, settings, told.build(dropout=settings.dropout))
    state = _resume_path(out, told, train, test, f"{mark} {on_gpu}")
    live = out.with_suffix("")
    recorder = _Recorder(live, progress)
    try:
        resumed_from = _fit(module, clouds, recorder, settings, state, on_gpu=on_gpu, workers=workers)
    except OSError as error:
        raise TrainingError(
            f"Cannot write the metrics of {live}: {error.strerror or error}. Free disk space and run the command again. It "
            "resumes at the last saved epoch."
        ) from error
    assert recorder.weights is not None
    module.network.load_state_dict(recorder.weights)
    network = module.network.to(place)
    regressor = Regressor(told, network)
    if not isinstance(network, Posterior):  # it has its own widths
        spread = _measured(regressor, clouds.test, clouds.validation).in_widths.mean(0)
        regressor = Regressor(told.model_copy(update={"spread": tuple(spread.tolist())}), network)
    summary = {
        "description": regressor.description.model_dump(mode="json"),
        "best_epoch": recorder.best_epoch,
        "history": recorder.history,
        "held_out": _held_out(regressor, clouds),
        "fingerprint": mark,
    }
    network.cpu()
    seconds = time.perf_counter() - began
    with together():
        write_json(live / "training.json", summary)
        regressor.write(out)
        write_timings(out, seconds, resumed=resumed_from)
    for left in out.parent.glob(f".{out.stem}.*.resume"):
        left.unlink(missing_ok=True)
    return TrainingResult(regressor, summary, seconds, resumed_from)


def _check_sets(train: SimulatedSet, test: SimulatedSet, settings: TrainingSettings) -> None:
    if train.names != test.names or train.scenario != test.scenario or train.nodes.shape[1:] != test.nodes.shape[1:]:
        raise ConfigError("The train and test sets have different scenarios or parameters. Generate both with one command.")
    if len(train) < 2 or len(test) < 4:
        raise ConfigError(f"Training needs at least 2 train and 4 test draws, got {len(train)} and {len(test)}.")
    if (settings.draws or 2) < 2 or settings.batch_size < 2:
        raise ConfigError(
            f"A batch needs at least 2 draws, for its normalisation; got draws {settings.draws}, batch_size "
            f"{settings.batch_size}."
        )
    if settings.target == "logarithmic" and (train.bounds <= 0).any():
        raise ConfigError("A logarithmic target needs positive bounds; use target: linear.")


@dataclass(frozen=True)
class _Clouds:
    """Data of one training."""

    train: CloudDataset
    test: CloudDataset
    background: BackgroundBody | None
    draws: int
    """Number of training samples that are used."""
    validation: list[int]
    held_out: list[int]

    @staticmethod
    def build(
        model: ModelName, train: SimulatedSet, test: SimulatedSet, settings: TrainingSettings, *, device: torch.device
    ) -> _Clouds:
        augmentation = Augmentation() if settings.augment else Augmentation.none()
        if settings.viewpoints:
            augmentation = Augmentation.recorded(settings.viewpoints)
        frames = frames_seen(model)
        body = train.obstacle if settings.subtract_background else None
        described = None if body is None else BackgroundBody.of(body, BACKGROUND_REACH_M / train.length_unit_m)
        background = None if described is None else described.build(device=device)
        # the test clouds are the same in all epochs and have their own random numbers
        sets = [
            CloudDataset(
                simulated,
                augmentation,
                frames=frames,
                points=settings.points,
                background=background,
                seed=seed,
                device=device,
            )
            for simulated, seed in ((train, settings.seed), (test, settings.seed + 1))
        ]
        split = max(1, round(_VALIDATION * len(sets[1])))
        draws = min(len(sets[0]), settings.draws or len(sets[0]))
        return _Clouds(sets[0], sets[1], described, draws, list(range(split)), list(range(split, len(sets[1]))))


def _centre_and_length(dataset: CloudDataset) -> tuple[tuple[float, float, float], float]:
    """Return the mean of some training clouds, and the largest distance from it. Scaled clouds fill the unit sphere,
    for which the published radii are meant."""
    clouds, _ = dataset.batch(range(min(_SCALE_SAMPLES, len(dataset))))
    points = clouds.flatten(0, 2).double()
    centre = points.mean(0)
    x, y, z = centre.tolist()
    return (x, y, z), float((points - centre).norm(dim=-1).max())


class _Batches(Dataset[tuple[Tensor, Tensor]]):
    """Dataset of whole batches, indexed by (epoch, indices)."""

    def __init__(self, dataset: CloudDataset) -> None:
        self.dataset = dataset

    def __getitem__(self, item: tuple[int, Sequence[int]]) -> tuple[Tensor, Tensor]:
        epoch, indices = item
        self.dataset.set_epoch(epoch)
        return self.dataset.batch(indices)


class _Order(Sampler[tuple[int, list[int]]]):
    """Batches of one epoch. A shuffled epoch drops an incomplete last batch, because of batch normalisation."""

    def __init__(self, indices: Sequence[int], batch_size: int, *, shuffle_seed: int | None) -> None:
        self.indices, self.batch_size, self.seed = list(indices), min(batch_size, len(indices)), shuffle_seed
        self.epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch; Lightning calls this."""
        self.epoch = epoch if self.seed is not None else 0

    def __len__(self) -> int:
        size = len(self.indices)
        return size // self.batch_size if self.seed is not None else math.ceil(size / self.batch_size)

    def __iter__(self) -> Iterator[tuple[int, list[int]]]:
        order = np.array(self.indices)
        if self.seed is not None:
            order = np.random.default_rng([self.seed, self.epoch]).permutation(order)
        for begin in range(0, len(self) * self.batch_size, self.batch_size):
            yield self.epoch, order[begin : begin + self.batch_size].tolist()


class _Training(lightning.LightningModule):
    """Lightning module with loss and optimiser."""

    def __init__(self, told: Description, settings: TrainingSettings, network: nn.Module) -> None:
        super().__init__()
        self.told, self.settings, self.network = told, settings, network
        self.train_losses: list[Tensor] = []
        self.validation_losses: list[tuple[Tensor, int]] = []

    def loss(self, batch: tuple[Tensor, Tensor]) -> Tensor:
        clouds, parameters = batch
        clouds = (clouds - clouds.new_tensor(self.told.centre)) / self.told.length
        scale = OutputScale(parameters.new_tensor(self.told.bounds), self.told.target)
        if isinstance(self.network, Posterior):
            return self.network.loss(clouds, scale.from_linear(parameters))
        outputs = self.network(clouds).float()
        return parameter_loss(outputs, parameters, scale, loss=self.settings.loss)

    def on_train_epoch_start(self) -> None:
        torch.manual_seed(int(np.random.SeedSequence([self.settings.seed, self.current_epoch]).generate_state(1)[0]))
        self.train_losses, self.validation_losses = [], []

    def training_step(self, batch: tuple[Tensor, Tensor], _: int) -> Tensor:
        loss = self.loss(batch)
        self.train_losses.append(loss.detach())
        return loss

    def validation_step(self, batch: tuple[Tensor, Tensor], _: int) -> None:
        self.validation_losses.append((self.loss(batch), len(batch[0])))

    def on_validation_epoch_end(self) -> None:
        losses, counts = zip(*self.validation_losses, strict=True)
        weights = torch.tensor(counts, dtype=losses[0].dtype, device=losses[0].device)
        self.log("validation_loss", (torch.stack(losses) * weights).sum() / weights.sum())

    def configure_optimizers(self) -> Any:
        optimiser = torch.optim.Adam(self.network.parameters(), lr=self.settings.learning_rate, fused=True)
        if self.settings.schedule == "constant":
            return optimiser
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, int(self.trainer.estimated_stepping_batches))
        return {"optimizer": optimiser, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


def parameter_loss(outputs: Tensor, parameters: Tensor, scale: OutputScale, *, loss: Loss) -> Tensor:
    """Return the mean L1 error of the parameters, or the Laplace negative log-likelihood if the outputs have widths.

    Args:
        outputs: [B, k], or [B, 2k] with logarithms of Laplace widths b. The loss is then mean(|error| / b + log b),
            which is L1 for b = 1.
        parameters: [B, k] linear fractions of the range.
        loss: `normalised` on the target's scale, `raw` in the parameters' units.
    """
    fractions, log_width = split_outputs(outputs, parameters.shape[1])
    true = scale.from_linear(parameters)
    error = (fractions - true) if loss == "normalised" else (scale.values(fractions) - scale.values(true))
    return (error.abs() * torch.exp(-log_width) + log_width).mean()


class _Recorder(lightning.Callback):
    """Callback that keeps history and best weights, as part of the saved state."""

    def __init__(self, live: Path, progress: Callable[[TrainingProgress], None] | None) -> None:
        self.folder, self.progress = live, progress
        self.history: list[dict[str, float]] = []
        self.best, self.best_epoch = math.inf, -1
        self.weights: dict[str, Tensor] | None = None
        self._live: Any = None

    def state_dict(self) -> dict[str, Any]:
        return {
            "history": self.history,
            "best": self.best,
            "best_epoch": self.best_epoch,
            "weights": self.weights,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.history, self.best = state_dict["history"], state_dict["best"]
        self.best_epoch, self.weights = state_dict["best_epoch"], state_dict["weights"]

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        self._live = _metrics_writer(self.folder)
        for row in self.history:
            self._log(row)

    def on_train_epoch_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        assert isinstance(pl_module, _Training)
        row = {
            "train_loss": float(torch.stack(pl_module.train_losses).mean()),
            "validation_loss": float(trainer.callback_metrics["validation_loss"]),
        }
        if not all(map(math.isfinite, row.values())):
            raise TrainingError(
                f"The losses of epoch {len(self.history) + 1} are {row['train_loss']:g} (training) and "
                f"{row['validation_loss']:g} (validation). Try a learning rate below {pl_module.settings.learning_rate:g}."
            )
        self.history.append(row)
        if row["validation_loss"] < self.best:
            self.best, self.best_epoch = row["validation_loss"], len(self.history)
            self.weights = {name: tensor.cpu().clone() for name, tensor in pl_module.network.state_dict().items()}
        self._log(row)
        if self.progress is not None:
            self.progress(TrainingProgress(len(self.history), row["train_loss"], row["validation_loss"], self.best))

    def teardown(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, stage: str) -> None:
        if self._live is not None:
            self._live.end()

    def _log(self, row: Mapping[str, float]) -> None:
        for name, value in row.items():
            self._live.log_metric(name, value)
        self._live.next_step()


def _metrics_writer(folder: Path) -> Any:
    """Return a DVCLive writer of metrics files only. Experiments, dvc.yaml and reports are handled elsewhere."""
    from dvclive import Live  # type: ignore[attr-defined]  # does not declare what it exports

    class Metrics(Live):
        def _init_dvc(self) -> None:
            # Not called, since the files need no repository. The original opens the Git repository around the current
            # folder without closing it, and initialises DVC there.
            pass

    return Metrics(str(folder), report=None, save_dvc_exp=False, dvcyaml=None)


class _Saver(lightning.Callback):
    """Callback that saves the whole state at intervals, so that a killed run can be resumed."""

    def __init__(self, path: Path) -> None:
        self.path, self.last = path, time.monotonic()

    def on_train_epoch_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        if time.monotonic() - self.last >= _SAVE_EVERY_S:
            self.save(trainer)

    def save(self, trainer: lightning.Trainer) -> None:
        # Lightning can only write to files, and not atomically
        with TemporaryDirectory(prefix="diffcloud-") as folder:
            trainer.save_checkpoint(Path(folder) / "state")
            write_bytes(self.path, (Path(folder) / "state").read_bytes())
        self.last = time.monotonic()


def _fit(
    module: _Training,
    clouds: _Clouds,
    recorder: _Recorder,
    settings: TrainingSettings,
    state: Path,
    *,
    on_gpu: bool,
    workers: int,
) -> int:
    """Run the epochs. Return the number that an earlier run had completed."""
    earlier = _readable_state(state)
    shuffled = _Order(range(clouds.draws), settings.batch_size, shuffle_seed=settings.seed)
    shuffled.set_epoch(earlier)  # Lightning requests the first batch before it sets the epoch
    in_order = _Order(clouds.validation, settings.batch_size, shuffle_seed=None)
    train, validation = (
        # own generator, because starting a loader draws a number, which would change a resumed run
        DataLoader(_Batches(dataset), sampler=order, batch_size=None, num_workers=workers, generator=torch.Generator())
        for dataset, order in ((clouds.train, shuffled), (clouds.test, in_order))
    )
    callbacks: list[lightning.Callback] = [recorder]
    if settings.patience is not None:
        callbacks.append(EarlyStopping("validation_loss", patience=settings.patience))
    callbacks.append(_Saver(state))  # last, so that the state includes the other callbacks
    with _quiet():
        trainer = lightning.Trainer(
            accelerator="gpu" if on_gpu else "cpu",
            devices=1,
            precision="bf16-mixed" if on_gpu else "32-true",
            max_epochs=settings.epochs,
            callbacks=callbacks,
            num_sanity_val_steps=0,
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
        )
        handler = signal.getsignal(signal.SIGINT)
        try:
            trainer.fit(module, train, validation, ckpt_path=str(state) if earlier else None, weights_only=True)
        except SystemExit as exit_:
            # Lightning turns Ctrl-C into an exit and disables it
            signal.signal(signal.SIGINT, handler)
            raise KeyboardInterrupt from exit_
    return earlier


def _readable_state(path: Path) -> int:
    """Return the number of completed epochs in a saved state, or 0. A damaged file is deleted."""
    try:
        saved = torch.load(path, map_location="cpu", weights_only=True)
        return int(saved["epoch"]) + 1
    except (OSError, RuntimeError, KeyError, TypeError, ValueError, EOFError, pickle.UnpicklingError):
        path.unlink(missing_ok=True)
        return 0


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress Lightning's messages, since the commands have their own progress display."""
    loggers = [logging.getLogger(name) for name in ("lightning.pytorch", "lightning.fabric", "dvclive")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PossibleUserWarning)  # that more workers may be quicker
            warnings.filterwarnings("ignore", message=".*LeafSpec", module="lightning")  # Lightning's use of torch's trees
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def _resume_path(out: Path, told: Description, train: SimulatedSet, test: SimulatedSet, made_by: str) -> Path:
    """Return the path of the hidden state file. Its name has a hash of settings and data, so that no other state is
    resumed.

    Args:
        made_by: code and type of processor, which affect the numbers too.
    """
    digest = hashlib.sha256((told.model_dump_json() + made_by).encode())
    for array in (train.parameters, train.nodes, test.parameters, test.nodes):
        digest.update(np.ascontiguousarray(array).data)
    return out.parent / f".{out.stem}.{digest.hexdigest()[:12]}.resume"


@dataclass(frozen=True)
class _Measured:
    """Predictions for n samples compared with the true values."""

    in_widths: Tensor
    """[n, k] absolute errors in widths."""
    off: Tensor
    """[n, k] predicted minus true values, in the parameters' units."""
    inside: Tensor
    """bool [n, L, k], whether intervals of the L levels in `LEVELS` contain the true value."""
    ranks: Tensor | None
    """[n, k + 1] for a posterior: fractions of samples below the true values, and of samples with higher density."""


def _measured(regressor: Regressor, dataset: CloudDataset, indices: Sequence[int]) -> _Measured:
    dataset.set_epoch(0)
    parts: list[tuple[Tensor, ...]] = []
    step, network = regressor.description.training["settings"]["batch_size"], regressor.network
    for begin in range(0, len(indices), step):
        clouds, parameters = dataset.batch(indices[begin : begin + step])
        found, parameters = regressor.predict_prepared(clouds), parameters.cpu()
        fractions, (low, high) = found.scale.from_linear(parameters), found.scale.bounds.unbind(-1)
        true = low + (high - low) * parameters
        ends = [found.interval(level) for level in LEVELS]
        inside = torch.stack([(low <= true) & (true <= high) for low, high in ends], dim=1)
        ranks = torch.empty(len(true), 0)
        if isinstance(network, Posterior) and found.samples is not None:
            drawn = torch.cat([fractions[:, None], found.scale.fractions(found.samples)], dim=1)
            with torch.no_grad():
                seen = regressor.scaled(clouds)
                density = network.log_density(seen, drawn.to(seen.device)).cpu()
            denser = (density[:, 1:] > density[:, :1]).float().mean(1)
            ranks = torch.cat([(found.samples < true[:, None]).float().mean(1), denser[:, None]], dim=1)
        parts.append(((found.fractions - fractions).abs() / found.width, found.values - true, inside, ranks))
    in_widths, off, inside, ranks = (torch.cat(column) for column in zip(*parts, strict=True))
    return _Measured(in_widths, off, inside, ranks if ranks.shape[1] else None)


def _held_out(regressor: Regressor, clouds: _Clouds) -> dict[str, Any]:
    """Return held-out errors, and those of constant predictors (mean and median of the training set)."""
    names = regressor.description.names
    measured = _measured(regressor, clouds.test, clouds.held_out)
    off, coverage = measured.off.double().numpy(), measured.inside.double().mean(0).numpy()
    true = clouds.test.simulated.parameters[clouds.held_out]
    trained = clouds.train.simulated.parameters[: clouds.draws]
    span = np.ptp(clouds.train.simulated.bounds, axis=1)
    told: dict[str, Any] = {
        "draws": len(true),
        "parameters": {
            name: {
                "median_relative_error": float(np.median(np.abs(off[:, index]) / true[:, index])),
                "median_relative_error_of_mean": float(
                    np.median(np.abs(trained[:, index].mean() - true[:, index]) / true[:, index])
                ),
                "mean_error_of_range": float(np.abs(off[:, index]).mean() / span[index]),
                "mean_error_of_range_of_median": float(
                    np.abs(np.median(trained[:, index]) - true[:, index]).mean() / span[index]
                ),
                "coverage": coverage[:, index].tolist(),
            }
            for index, name in enumerate(names)
        },
        "levels": list(LEVELS),
    }
    if measured.ranks is not None:
        ranks = measured.ranks.double().numpy()
        told["calibration"] = {
            # coverage of highest-density regions, over all parameters together (Hermans et al. 2022)
            "expected_coverage": [float((ranks[:, -1] <= level).mean()) for level in LEVELS],
            # simulation-based calibration: ranks of the true values are uniform (Talts et al. 2018), KS test
            "uniform_ranks": {name: float(kstest(ranks[:, index], "uniform").pvalue) for index, name in enumerate(names)},
        }
    return told
