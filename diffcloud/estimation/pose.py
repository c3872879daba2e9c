"""How a recording lies against the scene: fitted with the parameters, for each episode, and no property of the cloth.

The scene is turned about the recording's centre c by the rotation vector w = (tilt_x, tilt_y, yaw), shifted by
t = (x, y, z), shown e^scale times as large, and looked at later by `lag`:

    x' = e^scale exp([w]×) (x(time + lag) - c) + c + t

On a level table, x and y, and yaw of cloth, gripper and bodies together, are symmetries of the motion: they need no new
simulation. A cloth that lies turned under a gripper which does not turn is another motion; yaw only approximates it. z and
the tilts are those of the cameras against the robot, which a calibration knows to millimetres. `scale` is that of the
cameras' depths. One camera whose depths are 3 % too large shows everything 3 % larger, about itself; but where cameras were
registered by such depths, their clouds fit together, and are in place, where the board was. So the scale is about c, and
shifts are what is left. A cloud stamped t shows the motion at t + lag.

Where the recording knows its `clocks`, each camera has a lag of its own, `lag_<camera>`: a point of that camera stamped t
shows the motion at t + lag. Its prior is about the offset that the recording states. The motion is simulated at that time;
from there on, it follows its velocity v. All other priors are about zero.
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
"""Name -> unit."""
SET_UP = {"x": 0.002, "y": 0.002, "z": 0.002, "tilt_x": 0.005, "tilt_y": 0.005, "yaw": 0.005, "lag": 0.002}
"""Standard deviations of a calibrated set-up [m, rad, s]: of its cameras against the robot, and of its clock."""
BY_HAND = {"x": 0.1, "y": 0.1, "yaw": math.radians(30)}
"""Of where a hand lays a cloth that the scene places [m, rad]."""
_RESOLVED = {"m": 3e-4, "rad": 1.5e-3, "s": 3e-4, "1": 1.5e-3}
"""A step as small as this is the last one to a pose; what is left changes little."""
_ANGLES = ("tilt_x", "tilt_y", "yaw")
_SHIFTS = ("x", "y", "z")


_OF_CAMERA = "lag_"
ONE_CLOCK = {"lag": 0.0}
"""Variable of the clock that all cameras share -> offset [s], about which its prior is."""


def kind_of(name: str) -> str:
    """The name in `NUISANCE` of a variable: the lag of one camera is a `lag`."""
    return "lag" if name.startswith(_OF_CAMERA) else name


def unit_of(name: str, length_unit_m: float) -> float:
    """What one unit of a variable in a scene is in SI."""
    return length_unit_m if NUISANCE[kind_of(name)] == "m" else 1.0


def clocks_of(episode: Episode) -> dict[str, float]:
    """Variable of each camera's clock -> offset [s], about which its prior is; `ONE_CLOCK` where the episode states none.

    Raises:
        EpisodeError: the episode's `clocks` are damaged, or its points do not name their camera.
    """
    return {f"{_OF_CAMERA}{camera}": clock.offset_s for camera, clock in episode.clocks.items()} or ONE_CLOCK


def priors_by_clock(priors: Mapping[str, float], clocks: Collection[str]) -> dict[str, float]:
    """Priors [m, rad, s, 1] with a lag for each of these clocks: its own, else `lag`, else the widest. Without any lag in
    the priors, clocks are not free."""
    lags = {name: sigma for name, sigma in priors.items() if kind_of(name) == "lag"}
    others = {name: sigma for name, sigma in priors.items() if name not in lags}
    usual = lags.get("lag", max(lags.values(), default=0.0))
    return others | {clock: lags.get(clock, usual) for clock in clocks if lags}


def set_up_of(episode: Episode) -> dict[str, float]:
    """`SET_UP` with the clock of an episode, as far as preprocessing has measured it, its scale, where it says how far
    that may be off, and the `pose_sigmas` of its meta. Where the episode knows the clock of each camera, the deviation of
    its offset is added to that of the episode's own, as independent.

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
    """Name -> standard deviation [m, rad, s, 1], of a cloth put down by hand in front of the episode's set-up.

    Raises:
        EpisodeError: the episode's meta is damaged.
    """
    return set_up_of(episode) | {name: episode.pose_sigmas.get(name, sigma) for name, sigma in BY_HAND.items()}


def parse_priors(text: str) -> dict[str, float]:
    """What `--alignment` says -> name -> standard deviation of its prior [m, rad, s, 1], as of `parse_deviations`.

    Raises:
        ConfigError: an unknown name or unit, a unit of something else, or what is no positive number; names it.
    """
    return parse_deviations(text, "alignment", NUISANCE)


@dataclass(frozen=True)
class PoseSpace:
    """Which of the variables are free, and how far each may well be off."""

    names: tuple[str, ...]
    """d of them."""
    deviations: Tensor
    """[d] of their priors, in the scene's length unit, rad, s and 1. Values [..., d] are differences from the centre of the
    prior, which is the offset of a clock, and zero for all others."""
    resolved: Tensor
    """[d] a step no larger than this ends the search for a pose."""
    prior_weights: Tensor
    """[d] what the logarithm of the loss gains by the square of each variable (`estimation.priors`)."""
    centre: Tensor
    """[3] of the recording."""
    clocks: Mapping[str, float]
    """Variable of each of C clocks, free or not -> offset [s] about which its prior is."""

    @staticmethod
    def build(
        priors: Mapping[str, float], centre: Tensor, *, length_unit_m: float, clocks: Mapping[str, float] = ONE_CLOCK
    ) -> PoseSpace:
        """
        Args:
            priors: name -> standard deviation [m, rad, s, 1].
            clocks: variable of each clock -> offset [s].

        Raises:
            ConfigError: an unknown name, or what is no positive number.
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
        """[d] values as records keep them: name -> value and its prior, in SI."""
        return {
            name: NuisanceValue(
                value=float(value) * unit_of(name, length_unit_m) + self.clocks.get(name, 0.0),
                prior=float(prior) * unit_of(name, length_unit_m),
                unit=NUISANCE[kind_of(name)],
            )
            for name, value, prior in zip(self.names, values, self.deviations, strict=True)
        }

    def of(self, described: Mapping[str, NuisanceValue], *, length_unit_m: float) -> Tensor:
        """The inverse of `described`; what is missing there is at the centre of its prior."""
        values = [
            (described[name].value - self.clocks.get(name, 0.0)) / unit_of(name, length_unit_m)
            if name in described
            else 0.0
            for name in self.names
        ]
        return torch.tensor(values, dtype=torch.float64)

    def prior_factor(self, values: Tensor) -> Tensor:
        """[B] by which the priors multiply the loss at values [B, d]."""
        return (self.prior_weights * values.square()).sum(-1).exp()

    @property
    def unscaled(self) -> Tensor:
        """[d] factors that leave values as they are, but for the scale, which they set to zero."""
        return torch.tensor([name != "scale" for name in self.names], dtype=torch.float64)

    @property
    def moves_clocks(self) -> bool:
        """Whether the lag of any clock is free."""
        return any(name in self.clocks for name in self.names)

    def lags(self, values: Tensor) -> Tensor:
        """[B, C] difference of each clock from its stated offset [s], at values [B, d]."""
        return self._parts(values, tuple(self.clocks))

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
        """[T, V, 3] nodes of one motion in the recording's frame, at pose values [1, d]. With several clocks, the mean of
        their offsets applies.

        Args:
            at: times [T] of the motion -> nodes [1, T, V, 3] in the scene.
            times: [T] timestamps of the recording [s].
        """
        lags = self.lags(values) + torch.tensor(list(self.clocks.values()), dtype=torch.float64)
        return self.moved(at(times + lags.mean()), values)[0]

    def carried(self, vectors: Tensor, values: Tensor) -> Tensor:
        """[B, ..., 3] displacements in the scene at values [B, d] -> in the recording."""
        if not self.names:
            return vectors
        return _turned(vectors, self._matrix(values))

    def back(self, points: Tensor, values: Tensor) -> Tensor:
        """[..., 3] points of the recording -> [B, ..., 3] where the scene at values [B, d] has them."""
        shifted = points - _beside(self.centre + self._parts(values, _SHIFTS), points[None])
        return _turned(shifted, self.rotation(values).mT / self._growth(values)[..., None]) + self.centre

    def rates(self, points: Tensor, values: Tensor, velocities: Tensor | None, clock: Tensor) -> Tensor:
        """[d, B, ..., 3] derivatives of `moved` by the values.

        Args:
            velocities: [B, ..., 3] of the points; needed where a lag is free.
            clock: [B, ...] number of the clock of each point.
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
        """What x' = matrix (x + lag v - centre) + shift consists of at values [B, d]: centre [3], matrix [B, 3, 3], shift
        [B, 3] and lag [B, C] of each clock off its offset; and how the last three change with the values, [d, B, 3, 3],
        [d, 3] and [d, C]."""
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
        centre = self.centre if free else torch.zeros_like(self.centre)  # then `moved` leaves points as they are
        return centre, matrix, centre + shift, self.lags(values), matrix_rates, shift_rates, lag_rates

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
