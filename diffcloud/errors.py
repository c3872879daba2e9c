"""Errors for the user. Each message says what was found, what is allowed, and what to try."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


class DiffCloudError(Exception):
    """Base of all intentional errors. Commands print the message and exit with status 1."""


class MeshError(DiffCloudError):
    """A mesh that cannot be simulated (degenerate, non-manifold, or an index out of range)."""


class SceneError(DiffCloudError):
    """A scene or scenario description is invalid, or needs something unsupported."""


class EpisodeError(DiffCloudError):
    """A recorded episode or a cloud file that is damaged, empty, or of the wrong shape."""


class EmptyCloudError(EpisodeError):
    """A cloud file without points."""


class HardwareError(DiffCloudError):
    """A camera or an arm that is missing, cannot be opened, or failed while it ran."""


class LimitError(HardwareError):
    """A motion would exceed, or has exceeded, a limit that the user set: box, speed, acceleration, wrench."""


class UnconfirmedStopError(HardwareError):
    """The arm has not confirmed Stop. It may still be moving."""


class CalibrationError(DiffCloudError):
    """A calibration that cannot be made from the data, or does not belong to the camera."""


class RobotError(DiffCloudError):
    """A robot description that is damaged or incomplete, or a pose that the robot cannot take."""


class DatasetError(DiffCloudError):
    """A simulated set is missing, damaged, or inconsistent."""


class ConfigError(DiffCloudError):
    """A parameter file or command option that is wrong."""


class CheckpointError(DiffCloudError):
    """A file of trained weights that is missing, damaged, or of another model."""


class TrainingError(DiffCloudError):
    """Training cannot continue."""


class OutputError(DiffCloudError):
    """A file cannot be written, because the system or another process prevents it."""


class DivergedError(DiffCloudError):
    """A simulation diverged to non-finite values. The message has the step, batch entries and parameters."""

    def __init__(self, step: int, entries: list[int], reason: str, parameters: str = "") -> None:
        self.step, self.entries, self.reason, self.parameters = step, entries, reason, parameters
        where = f" with {parameters}" if parameters else ""
        super().__init__(
            f"The simulation diverged at step {step}, batch entries {entries}{where}: {reason}. "
            "Try a smaller time step (more frame_steps), parameters nearer the nominal material, "
            "a stiffer material, or a softer contact."
        )


class UnresolvedContactError(DivergedError):
    """The impacts of a time step could not be resolved."""

    def __init__(self, step: int, entries: list[int], pair: str, passes: int) -> None:
        self.pair = pair
        super().__init__(step, entries, f"{passes} passes did not resolve all impacts; the last was {pair}")


def unknown_name(kind: str, name: object, allowed: Iterable[object]) -> str:
    """Return the message for a name that is not allowed, with the most similar allowed name."""
    names = sorted(map(str, allowed))
    near = get_close_matches(str(name), names, n=1)
    meant = f" Did you mean {near[0]!r}?" if near else ""
    return f"Unknown {kind} {name!r}.{meant} Allowed: {', '.join(names)}."
