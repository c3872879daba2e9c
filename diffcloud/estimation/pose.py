"""Pose of a recording relative to the scene. It is fitted for each episode, and is no property of the cloth.

The pose rotates the scene about the recording's centre c by the rotation vector w = (tilt_x, tilt_y, yaw). It shifts
the scene by t = (x, y, z) and scales it by e^scale. Times are later by `lag`:

    x' = e^scale exp([w]×) (x(time + lag) - c) + c + t

On a level table, the motion does not change under x and y shifts, or under a common yaw of cloth, gripper and bodies.
So these variables need no further simulation. If only the cloth is rotated, and not the gripper's path, the motion is
different and yaw is an approximation. z and the tilts describe the extrinsics of the cameras relative to the robot,
which a calibration knows to millimetres.

`scale` describes depth errors of the cameras. A single camera whose depths are 3 % too large scales the scene about the
camera. Cameras that were registered with such depths agree at the calibration board, so their common error is a scale
about c and a shift.

A cloud stamped t shows the motion at t + lag. If the recording states `clocks`, each camera has its own lag,
`lag_<camera>`, with a prior centred on the stated offset. The motion is simulated at this stated offset and
extrapolated linearly by its velocity v from there. All other priors are centred on zero.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from diffcloud.errors import ConfigError, EpisodeError, unknown_name
from diffcloud.estimation.priors import INDEPENDENT
from diffcloud.estimation.record import NuisanceValue
from diffcloud.io.episodes import Episode
from diffcloud.quantities import parse_deviations

NUISANCE: dict[str, Literal["m", "rad", "s", "1"]] = {
    "x": "m",
    "y": "m",
    "z": "m",
    "tilt_x": "rad",
    "tilt_y": "rad",
    "yaw": "rad",
    "lag": "s",
    "scale": "1",
}
"""Pose variable -> unit."""
SET_UP = {"x": 0.002, "y": 0.002, "z": 0.002, "tilt_x": 0.005, "tilt_y": 0.005, "yaw": 0.005, "lag": 0.002}
"""Standard deviations for a calibrated set-up [m, rad, s]: camera extrinsics relative to the robot, and clock."""
BY_HAND = {"x": 0.1, "y": 0.1, "yaw": math.radians(30)}
"""Standard deviations for a cloth that is placed by hand at its position in the scene [m, rad]."""
_RESOLVED = {"m": 3e-4, "rad": 1.5e-3, "s": 3e-4, "1": 1.5e-3}
"""The pose search ends when all steps are smaller than this, by unit. Smaller changes hardly affect the loss."""
_ANGLES = ("tilt_x", "tilt_y", "yaw")
_SHIFTS = ("x", "y", "z")


_OF_CAMERA = "lag_"
ONE_CLOCK = {"lag": 0.0}
"""Lag variable of a single clock that all cameras share -> centre of its prior [s]."""


def kind_of(name: str) -> str:
    """Return the key of a variable in `NUISANCE`: the lag of one camera maps to `lag`."""
    return "lag" if name.startswith(_OF_CAMERA) else name


def unit_of(name: str, length_unit_m: float) -> float:
    """Return the SI value of one unit of a pose variable in the scene."""
    return length_unit_m if NUISANCE[kind_of(name)] == "m" else 1.0


def clocks_of(episode: Episode) -> dict[str, float]:
    """Return the lag variable of each camera -> stated offset [s], or `ONE_CLOCK` if the episode states none.

    Raises:
        EpisodeError: the episode's `clocks` are damaged, or its points do not name their camera.
    """
    return {f"{_OF_CAMERA}{camera}": clock.offset_s for camera, clock in episode.clocks.items()} or ONE_CLOCK


def priors_by_clock(priors: Mapping[str, float], clocks: Collection[str]) -> dict[str, float]:
    """Return priors [m, rad, s, 1] with one lag for each of these clocks. A clock without its own prior gets that of
    `lag`, or else the widest one. If no prior names a lag, the clocks are fixed."""
    lags = {name: sigma for name, sigma in priors.items() if kind_of(name) == "lag"}
    others = {name: sigma for name, sigma in priors.items() if name not in lags}
    usual = lags.get("lag", max(lags.values(), default=0.0))
    return others | {clock: lags.get(clock, usual) for clock in clocks if lags}


def set_up_of(episode: Episode) -> dict[str, float]:
    """Return `SET_UP` updated by what the episode's meta states: measured clock offset, scale uncertainty and
    `pose_sigmas`.

    If the episode states a clock for each camera, the deviations of the camera and the episode are added as
    independent.

    Raises:
        EpisodeError: the episode's meta is damaged.
    """
    measured = {"lag": episode.lag_sigma_s, "scale": episode.scale_sigma}
    found = SET_UP | {name: sigma for name, sigma in measured.items() if sigma is not None} | _pose_sigmas(episode)
    own = found.pop("lag")
    sigmas = {f"{_OF_CAMERA}{camera}": math.hypot(own, clock.sigma_s) for camera, clock in episode.clocks.items()}
    return found | (sigmas or {"lag": own})


def _pose_sigmas(episode: Episode) -> dict[str, float]:
    told = episode.pose_sigmas
    if unknown := set(told) - set(NUISANCE):
        raise EpisodeError(
            f"pose_sigmas of an episode's meta name {', '.join(sorted(unknown))}. They may name {', '.join(NUISANCE)}. "
            "Correct them, or remove `pose_sigmas`."
        )
    return told


def default_priors(episode: Episode) -> dict[str, float]:
    """Return pose variable -> standard deviation [m, rad, s, 1] for a cloth placed by hand before calibrated cameras.

    Raises:
        EpisodeError: the episode's meta is damaged.
    """
    return set_up_of(episode) | {name: episode.pose_sigmas.get(name, sigma) for name, sigma in BY_HAND.items()}


def parse_priors(text: str) -> dict[str, float]:
    """Parse the text of `--alignment` to pose variable -> standard deviation [m, rad, s, 1].

    Raises:
        ConfigError: a name or unit is unknown, a unit does not fit the variable, or a number is not positive.
    """
    return parse_deviations(text, "alignment", NUISANCE)


@dataclass(frozen=True)
class PoseSpace:
    """The free pose variables and their priors."""

    names: tuple[str, ...]
    """Names of the d free variables."""
    deviations: Tensor
    """[d] standard deviations of the priors, in the scene's length unit, rad, s and 1. Pose values [..., d] are
    differences from the prior's centre, which is the stated offset for a clock and zero for all others."""
    resolved: Tensor
    """[d] step sizes below which the pose search ends."""
    prior_weights: Tensor
    """[d] weights of the squared variables in the logarithm of the loss (`estimation.priors`)."""
    centre: Tensor
    """[3] centre of the recording, about which the scene is rotated."""
    clocks: Mapping[str, float]
    """Lag variable of each of the C clocks, free or not -> offset [s] on which its prior is centred."""

    @staticmethod
    def build(
        priors: Mapping[str, float], centre: Tensor, *, length_unit_m: float, clocks: Mapping[str, float] = ONE_CLOCK
    ) -> PoseSpace:
        """Build the space of the pose variables that have a prior.

        Args:
            priors: name -> standard deviation [m, rad, s, 1].
            centre: [3] centre of the recording.
            clocks: lag variable of each clock -> offset [s].

        Raises:
            ConfigError: a name is unknown, or a standard deviation is not positive.
        """
        known = [one for name in NUISANCE for one in (clocks if name == "lag" else (name,))]
        for name, value in priors.items():
            if name not in known:
                raise ConfigError(unknown_name("nuisance variable", name, known))
            if not (value > 0 and math.isfinite(value)):
                unit = NUISANCE[kind_of(name)]
                raise ConfigError(f"The prior of {name} must be a positive number of {unit}, got {value!r}.")
        names = tuple(name for name in known if name in priors)
        units = torch.tensor([unit_of(name, length_unit_m) for name in names], dtype=torch.float64)
        deviations = torch.tensor([priors[name] for name in names], dtype=torch.float64) / units
        resolved = torch.tensor([_RESOLVED[NUISANCE[kind_of(name)]] for name in names], dtype=torch.float64) / units
        return PoseSpace(names, deviations, resolved, 1 / (INDEPENDENT * deviations**2), centre, clocks)

    def described(self, values: Tensor, *, length_unit_m: float) -> dict[str, NuisanceValue]:
        """Convert pose values [d] to the form of the fit record: name -> value and prior, in SI units."""
        return {
            name: NuisanceValue(
                value=float(value) * unit_of(name, length_unit_m) + self.clocks.get(name, 0.0),
                prior=float(prior) * unit_of(name, length_unit_m),
                unit=NUISANCE[kind_of(name)],
            )
            for name, value, prior in zip(self.names, values, self.deviations, strict=True)
        }

    def of(self, described: Mapping[str, NuisanceValue], *, length_unit_m: float) -> Tensor:
        """Return the inverse of `described`; missing variables are at the centre of their prior."""
        values = [
            (described[name].value - self.clocks.get(name, 0.0)) / unit_of(name, length_unit_m)
            if name in described
            else 0.0
            for name in self.names
        ]
        return torch.tensor(values, dtype=torch.float64)

    def prior_factor(self, values: Tensor) -> Tensor:
        """Return factors [B] by which the priors multiply the loss at values [B, d]."""
        return (self.prior_weights * values.square()).sum(-1).exp()

    @property
    def unscaled(self) -> Tensor:
        """[d] factors that set the scale to zero and keep all other variables."""
        return torch.tensor([name != "scale" for name in self.names], dtype=torch.float64)

    @property
    def moves_clocks(self) -> bool:
        """Whether the lag of any clock is free."""
        return any(name in self.clocks for name in self.names)

    def lags(self, values: Tensor) -> Tensor:
        """Return differences [B, C] of each clock from its stated offset [s], at values [B, d]."""
        return self._parts(values, tuple(self.clocks))

    def rotation(self, values: Tensor) -> Tensor:
        """Return rotation matrices [B, 3, 3] for values [B, d]."""
        return _rotation(self._parts(values, _ANGLES))

    def moved(self, points: Tensor, values: Tensor) -> Tensor:
        """Transform points [B, ..., 3] from the scene to the recording's frame at values [B, d]."""
        if not self.names:
            return points
        turned = self.carried(points - self.centre, values)
        return turned + _beside(self.centre + self._parts(values, _SHIFTS), turned)

    def moved_motion(self, at: Callable[[Tensor], Tensor], times: Tensor, values: Tensor) -> Tensor:
        """Return the nodes [T, V, 3] of one motion in the recording's frame, at pose values [1, d].

        If there are several clocks, the mean of their offsets is used.

        Args:
            at: function from motion times [T] to nodes [1, T, V, 3] in the scene.
            times: [T] timestamps of the recording [s].
        """
        lags = self.lags(values) + torch.tensor(list(self.clocks.values()), dtype=torch.float64)
        return self.moved(at(times + lags.mean()), values)[0]

    def carried(self, vectors: Tensor, values: Tensor) -> Tensor:
        """Transform displacements [B, ..., 3] from the scene to the recording's frame at values [B, d]."""
        if not self.names:
            return vectors
        return _turned(vectors, self._matrix(values))

    def back(self, points: Tensor, values: Tensor) -> Tensor:
        """Transform points [..., 3] from the recording's frame to the scene [B, ..., 3] at values [B, d]."""
        shifted = points - _beside(self.centre + self._parts(values, _SHIFTS), points[None])
        return _turned(shifted, self.rotation(values).mT / self._growth(values)[..., None]) + self.centre

    def rates(self, points: Tensor, values: Tensor, velocities: Tensor | None, clock: Tensor) -> Tensor:
        """Return the derivatives [d, B, ..., 3] of `moved` with respect to the pose values.

        Args:
            velocities: [B, ..., 3] velocities of the points; needed if a lag is free.
            clock: [B, ...] index of each point's clock.
        """
        _, matrix, _, _, *rates = self.placements(values)
        centred, found = points - self.centre, points.new_zeros(len(self.names), *points.shape)
        for column, turn, shift, late in zip(found, *rates, strict=True):
            column += _turned(centred, turn) + shift
            if late.any():
                assert velocities is not None
                column += late[clock][..., None] * _turned(velocities, matrix)
        return found

    def placements(self, values: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Return the parts of x' = matrix (x + lag v - centre) + shift at values [B, d], and their derivatives.

        Returns:
            centre [3], matrix [B, 3, 3], shift [B, 3], and lag [B, C] of each clock relative to its stated offset. Then
                the derivatives of matrix [d, B, 3, 3], shift [d, 3] and lag [d, C].
        """
        count, free = len(values), len(self.names)
        growth, angles = self._growth(values)[..., None], self._parts(values, _ANGLES)
        matrix, shift, clocks = self._matrix(values), self._parts(values, _SHIFTS), list(self.clocks)
        shapes = (count, 3, 3), (3,), (len(clocks),)
        matrix_rates, shift_rates, lag_rates = (values.new_zeros(free, *shape) for shape in shapes)
        turnings = growth * _turnings(angles)
        for place, name in enumerate(self.names):
            if name in self.clocks:
                lag_rates[place, clocks.index(name)] = 1.0
            elif name == "scale":
                matrix_rates[place] = matrix
            elif name in _SHIFTS:
                shift_rates[place, _SHIFTS.index(name)] = 1.0
            else:
                matrix_rates[place] = turnings[_ANGLES.index(name)]
        centre = self.centre if free else torch.zeros_like(self.centre)  # so that `moved` is the identity
        return centre, matrix, centre + shift, self.lags(values), matrix_rates, shift_rates, lag_rates

    def _matrix(self, values: Tensor) -> Tensor:
        """Return scaled rotation matrices [B, 3, 3] for values [B, d]."""
        return self._growth(values)[..., None] * self.rotation(values)

    def _growth(self, values: Tensor) -> Tensor:
        """Return scale factors [B, 1] for values [B, d]."""
        return self._parts(values, ("scale",)).exp()

    def _parts(self, values: Tensor, names: tuple[str, ...]) -> Tensor:
        """Select the named columns [B, n] of values [B, d]; variables that are not free are zero."""
        zero = values.new_zeros(len(values))
        return torch.stack([values[:, self.names.index(n)] if n in self.names else zero for n in names], dim=-1)


def _rotation(vectors: Tensor) -> Tensor:
    """Return rotation matrices [B, 3, 3] of rotation vectors w [B, 3] with θ = |w|: I + sin θ / θ [w]× + (1 - cos θ) /
    θ² [w]×² (Rodrigues' formula)."""
    cross, (first, second, _) = _cross(vectors), _weights(vectors)
    return torch.eye(3, dtype=vectors.dtype) + first * cross + second * (cross @ cross)


def _turnings(vectors: Tensor) -> Tensor:
    """Return the derivatives [3, B, 3, 3] of the rotation with respect to the components of w. Along axis e it is [J
    e]× times the rotation, with J = I + (1 - cos θ) / θ² [w]× + (θ - sin θ) / θ³ [w]×² (Chirikjian 2012, section
    10.8)."""
    cross, (_, second, third) = _cross(vectors), _weights(vectors)
    jacobian = torch.eye(3, dtype=vectors.dtype) + second * cross + third * (cross @ cross)
    return _cross(jacobian.movedim(-1, 0)) @ _rotation(vectors)


def _weights(vectors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return sin θ / θ, (1 - cos θ) / θ² and (θ - sin θ) / θ³, each [B, 1, 1], for vectors [B, 3] of length θ. θ = 0 is
    allowed. Rounding errors of the last term do not matter there, because it is multiplied by θ²."""
    squared = vectors.square().sum(-1)[:, None, None]
    turns = squared.sqrt() / torch.pi
    first = torch.sinc(turns)
    return first, torch.sinc(turns / 2).square() / 2, (1 - first) / squared.clamp(min=1e-300)


def _turned(points: Tensor, rotation: Tensor) -> Tensor:
    """Rotate points [B, ..., 3] by matrices [B, 3, 3]."""
    return (points.flatten(1, -2) @ rotation.mT).reshape(points.shape)


def _beside(vector: Tensor, points: Tensor) -> Tensor:
    """Reshape vectors [B, 3] to [B, 1, ..., 3], so that they broadcast with points [B, ..., 3]."""
    return vector.reshape(len(vector), *[1] * (points.dim() - 2), 3)


def _cross(vector: Tensor) -> Tensor:
    """Return the matrix [..., 3, 3] of the cross product with vectors [..., 3]."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
