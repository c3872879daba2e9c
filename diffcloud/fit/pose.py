"""How a recording lies against the scene: fitted with the parameters, for each episode, and no property of the cloth.

The scene is turned about the recording's centre c by the rotation vector w = (tilt_x, tilt_y, yaw), shifted by
t = (x, y, z), shown e^scale times as large, and looked at later by `lag`, as far as its velocity v tells:

    x' = e^scale exp([w]×) (x + lag v - c) + c + t

On a level table, x and y, and yaw of cloth, gripper and bodies together, are symmetries of the motion: they need no new
simulation. A cloth that lies turned under a gripper which does not turn is another motion; yaw only approximates it. z and
the tilts are those of the cameras against the robot, which a calibration knows to millimetres. `scale` is that of the
cameras' depths. One camera whose depths are 3 % too large shows everything 3 % larger, about itself; but where cameras were
registered by such depths, their clouds fit together, and are in place, where the board was. So the scale is about c, and
shifts are what is left. A cloud stamped t shows the motion at t + lag.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from diffcloud.errors import ConfigError, unknown_name
from diffcloud.fit.priors import INDEPENDENT, parse_deviations
from diffcloud.fit.record import NuisanceValue
from diffcloud.io.episodes import Episode

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
"""Name -> unit."""
SET_UP = {"x": 0.002, "y": 0.002, "z": 0.002, "tilt_x": 0.005, "tilt_y": 0.005, "yaw": 0.005, "lag": 0.002}
"""Standard deviations of a calibrated set-up [m, rad, s]: of its cameras against the robot, and of its clock."""
LAID = {"x": 0.1, "y": 0.1, "yaw": math.radians(30)}
"""Of where a hand lays a cloth that the scene places [m, rad]."""
TRIED = {**SET_UP, "scale": 0.01}
"""A small change of each variable, in the same units."""
_RESOLVED = {"m": 3e-4, "rad": 1.5e-3, "s": 3e-4, "1": 1.5e-3}
"""A step as small as this is the last one to a pose; what is left changes little."""
_ANGLES = ("tilt_x", "tilt_y", "yaw")
_SHIFTS = ("x", "y", "z")


def unit_of(name: str, length_unit_m: float) -> float:
    """What one unit of a variable in a scene is in SI."""
    return length_unit_m if NUISANCE[name] == "m" else 1.0


def set_up_of(episode: Episode) -> dict[str, float]:
    """`SET_UP` with the clock of an episode, as far as preprocessing has measured it, its scale, where it says how far
    that may be off, and the `pose_sigmas` of its meta.

    Raises:
        EpisodeError: the episode's meta is damaged.
    """
    measured = {"lag": episode.lag_sigma_s, "scale": episode.scale_sigma}
    return SET_UP | {name: sigma for name, sigma in measured.items() if sigma is not None} | episode.pose_sigmas


def default_priors(episode: Episode) -> dict[str, float]:
    """Name -> standard deviation [m, rad, s, 1], of a cloth laid by hand in front of the episode's set-up.

    Raises:
        EpisodeError: the episode's meta is damaged.
    """
    return {**set_up_of(episode), **LAID, **episode.pose_sigmas}


def parse_priors(text: str) -> dict[str, float]:
    """What `--nuisance` says -> name -> standard deviation of its prior [m, rad, s, 1], as of `parse_deviations`.

    Raises:
        ConfigError: an unknown name or unit, a unit of something else, or what is no positive number; names it.
    """
    return parse_deviations(text, "nuisance", NUISANCE)


@dataclass(frozen=True)
class PoseSpace:
    """Which of the variables are free, and how far each may well be off."""

    names: tuple[str, ...]
    """d of them."""
    deviations: Tensor
    """[d] of their priors about zero, in the scene's length unit, rad, s and 1."""
    resolved: Tensor
    """[d] a step no larger than this ends the search for a pose."""
    prior_weights: Tensor
    """[d] what the logarithm of the loss gains by the square of each variable (`fit.priors`)."""
    centre: Tensor
    """[3] of the recording."""

    @staticmethod
    def build(priors: Mapping[str, float], centre: Tensor, *, length_unit_m: float) -> PoseSpace:
        """
        Args:
            priors: name -> standard deviation [m, rad, s, 1].

        Raises:
            ConfigError: an unknown name, or what is no positive number.
        """
        for name, value in priors.items():
            if name not in NUISANCE:
                raise ConfigError(unknown_name("nuisance variable", name, NUISANCE))
            if not (value > 0 and math.isfinite(value)):
                raise ConfigError(f"The prior of {name} must be a positive number of {NUISANCE[name]}, got {value!r}.")
        names = tuple(name for name in NUISANCE if name in priors)
        units = torch.tensor([unit_of(name, length_unit_m) for name in names], dtype=torch.float64)
        deviations = torch.tensor([priors[name] for name in names], dtype=torch.float64) / units
        resolved = torch.tensor([_RESOLVED[NUISANCE[name]] for name in names], dtype=torch.float64) / units
        return PoseSpace(names, deviations, resolved, 1 / (INDEPENDENT * deviations**2), centre)

    def described(self, values: Tensor, *, length_unit_m: float) -> dict[str, NuisanceValue]:
        """[d] values as records keep them: name -> value and its prior, in SI."""
        return {
            name: NuisanceValue(
                value=float(value) * unit_of(name, length_unit_m),
                prior=float(prior) * unit_of(name, length_unit_m),
                unit=NUISANCE[name],
            )
            for name, value, prior in zip(self.names, values, self.deviations, strict=True)
        }

    def of(self, described: Mapping[str, NuisanceValue], *, length_unit_m: float) -> Tensor:
        """The inverse of `described`; what is missing there is zero."""
        values = [described[name].value / unit_of(name, length_unit_m) if name in described else 0.0 for name in self.names]
        return torch.tensor(values, dtype=torch.float64)

    def prior_factor(self, values: Tensor) -> Tensor:
        """[B] by which the priors multiply the loss at values [B, d]."""
        return (self.prior_weights * values.square()).sum(-1).exp()

    @property
    def unscaled(self) -> Tensor:
        """[d] factors that leave values as they are, but for the scale, which they set to zero."""
        return torch.tensor([name != "scale" for name in self.names], dtype=torch.float64)

    def lag(self, values: Tensor) -> Tensor | None:
        """[B] of values [B, d]; None where it is not free."""
        return values[:, self.names.index("lag")] if "lag" in self.names else None

    def rotation(self, values: Tensor) -> Tensor:
        """[B, 3, 3] of values [B, d]."""
        return _rotation(self._parts(values, _ANGLES))

    def moved(self, points: Tensor, values: Tensor) -> Tensor:
        """[B, ..., 3] points of the scene at values [B, d] -> where the recording has them."""
        if not self.names:
            return points
        turned = self.carried(points - self.centre, values)
        return turned + _beside(self.centre + self._parts(values, _SHIFTS), turned)

    def moved_motion(self, at: Callable[[Tensor], Tensor], times: Tensor, values: Tensor) -> Tensor:
        """[T, V, 3] where the recording has the nodes of one motion at times [T] of its own, at values [1, d].

        Args:
            at: times [T] -> nodes [1, T, V, 3].
        """
        lag = self.lag(values)
        return self.moved(at(times if lag is None else times + lag), values)[0]

    def carried(self, vectors: Tensor, values: Tensor) -> Tensor:
        """[B, ..., 3] displacements in the scene at values [B, d] -> in the recording."""
        if not self.names:
            return vectors
        return _turned(vectors, self._matrix(values))

    def back(self, points: Tensor, values: Tensor) -> Tensor:
        """[..., 3] points of the recording -> [B, ..., 3] where the scene at values [B, d] has them."""
        shifted = points - _beside(self.centre + self._parts(values, _SHIFTS), points[None])
        return _turned(shifted, self.rotation(values).mT / self._growth(values)[..., None]) + self.centre

    def rates(self, points: Tensor, values: Tensor, velocities: Tensor | None) -> Tensor:
        """[d, B, ..., 3] derivatives of `moved` by the values.

        Args:
            velocities: [B, ..., 3] of the points; needed where `lag` is free.
        """
        _, matrix, _, _, *rates = self.placements(values)
        centred, found = points - self.centre, points.new_zeros(len(self.names), *points.shape)
        for column, turn, shift, late in zip(found, *rates, strict=True):
            column += _turned(centred, turn) + shift
            if late:
                assert velocities is not None
                column += late * _turned(velocities, matrix)
        return found

    def placements(self, values: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
        """What x' = matrix (x + lag v - centre) + shift consists of at values [B, d]: centre [3], matrix [B, 3, 3], shift
        [B, 3] and lag [B]; and how the last three change with the values, [d, B, 3, 3], [d, 3] and [d]."""
        count, free = len(values), len(self.names)
        growth, angles = self._growth(values)[..., None], self._parts(values, _ANGLES)
        matrix, shift, lag = self._matrix(values), self._parts(values, _SHIFTS), self.lag(values)
        matrix_rates, shift_rates, lag_rates = (values.new_zeros(free, *each) for each in ((count, 3, 3), (3,), ()))
        turnings = growth * _turnings(angles)
        for place, name in enumerate(self.names):
            if name == "lag":
                lag_rates[place] = 1.0
            elif name == "scale":
                matrix_rates[place] = matrix
            elif name in _SHIFTS:
                shift_rates[place, _SHIFTS.index(name)] = 1.0
            else:
                matrix_rates[place] = turnings[_ANGLES.index(name)]
        centre = self.centre if free else torch.zeros_like(self.centre)  # then `moved` leaves points as they are
        lag = values.new_zeros(count) if lag is None else lag
        return centre, matrix, centre + shift, lag, matrix_rates, shift_rates, lag_rates

    def _matrix(self, values: Tensor) -> Tensor:
        """[B, 3, 3] of values [B, d]: turns and scales."""
        return self._growth(values)[..., None] * self.rotation(values)

    def _growth(self, values: Tensor) -> Tensor:
        """[B, 1] of values [B, d]: how many times as large the scene shows."""
        return self._parts(values, ("scale",)).exp()

    def _parts(self, values: Tensor, names: tuple[str, ...]) -> Tensor:
        """[B, n] of values [B, d]; zero for what is not free."""
        zero = values.new_zeros(len(values))
        return torch.stack([values[:, self.names.index(n)] if n in self.names else zero for n in names], dim=-1)


def _rotation(vectors: Tensor) -> Tensor:
    """[B, 3, 3] by vectors w [B, 3]: I + sin θ / θ [w]× + (1 - cos θ) / θ² [w]×², θ = |w| (Rodrigues)."""
    cross, (first, second, _) = _cross(vectors), _weights(vectors)
    return torch.eye(3, dtype=vectors.dtype) + first * cross + second * (cross @ cross)


def _turnings(vectors: Tensor) -> Tensor:
    """[3, B, 3, 3] the derivatives of the rotation by w along each axis e: [J e]× times the rotation, with
    J = I + (1 - cos θ) / θ² [w]× + (θ - sin θ) / θ³ [w]×² (Chirikjian 2012, section 10.8)."""
    cross, (_, second, third) = _cross(vectors), _weights(vectors)
    jacobian = torch.eye(3, dtype=vectors.dtype) + second * cross + third * (cross @ cross)
    return _cross(jacobian.movedim(-1, 0)) @ _rotation(vectors)


def _weights(vectors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """[B, 1, 1] sin θ / θ, (1 - cos θ) / θ² and (θ - sin θ) / θ³ of vectors of length θ [B, 3], for θ = 0 too: what
    rounding leaves of the last is multiplied by θ²."""
    squared = vectors.square().sum(-1)[:, None, None]
    turns = squared.sqrt() / torch.pi
    first = torch.sinc(turns)
    return first, torch.sinc(turns / 2).square() / 2, (1 - first) / squared.clamp(min=1e-300)


def _turned(points: Tensor, rotation: Tensor) -> Tensor:
    """[B, ..., 3] points by [B, 3, 3]."""
    return (points.flatten(1, -2) @ rotation.mT).reshape(points.shape)


def _beside(vector: Tensor, points: Tensor) -> Tensor:
    """[B, 3] -> [B, 1, ..., 3] as points [B, ..., 3] have dimensions."""
    return vector.reshape(len(vector), *[1] * (points.dim() - 2), 3)


def _cross(vector: Tensor) -> Tensor:
    """[..., 3] -> [..., 3, 3] that multiplies like a cross product."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
