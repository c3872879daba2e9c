"""This simulator beside the others: known answers, motions, what separates them, gradients."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from diffcloud.simulators import explicit, mujoco, newton, ours
from diffcloud.simulators.problem import Problem, Track, distances
from diffcloud.simulators.problems import cantilever, strip
from studies.towel_problems import fold, lift, swing

THIS = "this simulator"
WHOLE_STIFFNESS = "damping of the whole stiffness, as in ARCSim"
FINER = 4
"""Times the steps that this simulator's are compared with."""
_FINE = 1e-4
"""[s] MuJoCo's shorter step."""


@dataclass(frozen=True)
class Answer:
    """What a simulator makes of a test whose answer is known."""

    test: str
    simulator: str
    found: dict[str, float]
    theory: dict[str, float]


@dataclass(frozen=True)
class Pair:
    """A motion in two simulators."""

    problem: str
    what: str
    """What was changed, or which simulator moves."""
    against: str
    times: NDArray[np.float64]
    """[T] [s]"""
    apart: NDArray[np.float64]
    """[T] RMS over nodes [m]."""
    seconds: float
    """Of the one that moves, per second of motion."""

    def at(self, time: float) -> float:
        """Distance in the frame nearest to a time [m]; NaN after the end."""
        place = int(np.abs(self.times - time).argmin())
        return float(self.apart[place]) if abs(self.times[place] - time) < 1e-6 else float("nan")


@dataclass(frozen=True)
class Derivative:
    """Of the mean height at the end by the logarithm of E h."""

    simulator: str
    exact: float
    """[m]"""
    difference: float
    """Central, over `_SPREAD` of E h to both sides [m]."""
    forward: float
    """[s]"""
    backward: float
    """[s]"""


def known_answers() -> Iterator[Answer]:
    """The strip and the cantilever in all simulators."""
    for known, stiff in ((strip(), False), (cantilever(), True)):
        step = 4e-5 if stiff else 2e-4
        runs: dict[str, Callable[[Problem], Track]] = {
            THIS: ours.simulate,
            "MuJoCo": lambda problem, step=step: mujoco.simulate(problem, mujoco.Settings(step=step)),  # type: ignore[misc]
            "Newton, explicit": lambda problem, step=step: newton.simulate(  # type: ignore[misc]
                problem, newton.Settings("semi_implicit", step)
            ),
            "Newton, VBD, 1 ms": lambda problem: newton.simulate(problem, newton.Settings(step=1e-3)),
            "Newton, VBD, 0.1 ms": lambda problem: newton.simulate(problem, newton.Settings(step=1e-4)),
        }
        for name, run in runs.items():
            yield Answer(known.problem.name, name, known.measures(run(known.problem)), known.theory)


def motions() -> Iterator[Pair]:
    """Lift, fold and swing in all simulators."""
    for problem in (lift(), fold(), swing()):
        own = ours.simulate(problem)
        yield _pair(
            problem, f"{THIS}, {FINER} times the steps", THIS, own, ours.simulate(problem, steps=FINER * ours.STEPS)
        )
        rough, other = (mujoco.simulate(problem, mujoco.Settings(step=step)) for step in (mujoco.Settings.step, _FINE))
        yield _pair(problem, "MuJoCo, 0.2 ms", THIS, own, rough)
        yield _pair(problem, "MuJoCo, 0.1 ms", THIS, own, other)
        yield _pair(problem, "MuJoCo, 0.2 ms", "MuJoCo, 0.1 ms", other, rough)
        block = newton.simulate(problem)
        yield _pair(problem, "Newton, VBD", THIS, own, block)
        yield _pair(problem, "Newton, VBD", "MuJoCo, 0.1 ms", other, block)
        if not problem.self_contact:
            free = _damped(problem, 0.0)
            own, other = ours.simulate(free), mujoco.simulate(free, mujoco.Settings(step=_FINE))
            plain = newton.simulate(free, newton.EXPLICIT)
            yield _pair(problem, "Newton, explicit, no damping", f"{THIS}, no damping", own, plain)
            yield _pair(problem, "Newton, explicit, no damping", "MuJoCo, 0.1 ms, no damping", other, plain)


def opinions() -> Iterator[Pair]:
    """The third opinion with each simulator's choices, against both."""
    for problem in (lift(), swing()):
        own = ours.simulate(problem, steps=FINER * ours.STEPS)
        other = mujoco.simulate(problem, mujoco.Settings(step=_FINE))
        free = _damped(problem, 0.0)
        rows: list[tuple[str, Problem, explicit.Choices, dict[str, Track]]] = [
            ("as this simulator", problem, explicit.Choices(), {THIS: own, "MuJoCo": other}),
            (
                WHOLE_STIFFNESS,
                problem,
                explicit.Choices(rotation_damped=True),
                {THIS: own, "MuJoCo": other},
            ),
            (
                "hinges by their chord, as in MuJoCo",
                problem,
                explicit.Choices(chord=True),
                {THIS: own, "MuJoCo": other},
            ),
            (
                "no damping, membrane as in Newton",
                free,
                explicit.Choices(neo_hookean=True),
                {
                    f"{THIS}, no damping": ours.simulate(free, steps=FINER * ours.STEPS),
                    "Newton, explicit, no damping": newton.simulate(free, newton.EXPLICIT),
                },
            ),
        ]
        for name, given, chosen, others in rows:
            third = explicit.simulate(given, chosen)
            for against, track in others.items():
                yield _pair(given, name, against, track, third)


Run = Callable[[Problem], Track]


def switches() -> Iterator[Pair]:
    """This simulator against MuJoCo in the lift and in the swing, with one thing changed at a time."""
    plain = mujoco.Settings()
    fine, finest = replace(plain, step=_FINE), replace(plain, step=5e-5)

    def changed(**fields: object) -> Run:
        return lambda problem: mujoco.simulate(problem, replace(plain, **fields))  # type: ignore[arg-type]

    def with_steps(settings: mujoco.Settings) -> Run:
        return lambda problem: mujoco.simulate(problem, settings)

    def sheet(**fields: float) -> Callable[[Problem], Problem]:
        return lambda problem: replace(problem, sheet=replace(problem.sheet, **fields))

    def rougher(problem: Problem) -> Track:
        return ours.simulate(replace(problem, friction=1.03 * problem.friction))

    def same(problem: Problem) -> Problem:
        return problem

    rows: list[tuple[str, Callable[[Problem], Problem], Run, Run]] = [
        ("nothing", same, ours.simulate, with_steps(plain)),
        ("integrator: of first order here", same, lambda p: ours.simulate(p, order=1), with_steps(plain)),
        (
            "integrator: steps a quarter as long here",
            same,
            lambda p: ours.simulate(p, steps=FINER * ours.STEPS),
            with_steps(plain),
        ),
        ("integrator: MuJoCo's steps a quarter as long", same, ours.simulate, with_steps(finest)),
        ("damping: none in both", sheet(damping=0.0), ours.simulate, with_steps(fine)),
        ("damping: four times in both", sheet(damping=0.02), ours.simulate, with_steps(finest)),
        ("Poisson's ratio: 0 in both", sheet(poisson=0.0), ours.simulate, with_steps(plain)),
        ("bending: a tenth in both", sheet(bending=3e-7), ours.simulate, with_steps(plain)),
        ("bending: ten times in both", sheet(bending=3e-5), ours.simulate, with_steps(plain)),
        ("bending: MuJoCo's thickness that of a solid sheet", same, ours.simulate, changed(solid=True)),
        ("handle: of 1 kg in MuJoCo", same, ours.simulate, changed(holding_mass=1.0)),
        ("self-contact: in both", lambda p: replace(p, self_contact=True), ours.simulate, with_steps(plain)),
    ]
    table: list[tuple[str, Callable[[Problem], Problem], Run, Run]] = [
        ("friction: none in both", lambda p: replace(p, friction=1e-6), ours.simulate, with_steps(plain)),
        ("friction: twice in both", lambda p: replace(p, friction=0.6), ours.simulate, with_steps(plain)),
        ("friction: MuJoCo's pyramidal cone", same, ours.simulate, changed(cone="pyramidal")),
        ("friction: MuJoCo's impratio 1", same, ours.simulate, changed(impratio=1.0)),
        ("thickness: MuJoCo's nodes lie 0.6 mm lower", same, ours.simulate, changed(radius=0.0015)),
        ("thickness: MuJoCo's contacts five times softer", same, ours.simulate, changed(contact_time=0.01)),
        ("mesh: cells halved in both", lambda p: lift(refinement=2), ours.simulate, with_steps(finest)),
        ("for scale: 3 % more friction in this simulator alone", same, ours.simulate, rougher),
    ]
    for problem in (lift(), swing()):
        for what, change, one, two in rows + (table if problem.table is not None else []):
            given = change(problem)
            yield _pair(problem, what, THIS, one(given), two(given))


_SPREAD = 0.01


def gradients() -> Iterator[Derivative]:
    """Of the swing's first half second, without damping."""
    problem = _damped(replace(swing(), seconds=0.5), 0.0)
    for name, height in ((THIS, ours.mean_height), ("Newton, explicit", newton.mean_height)):
        _, exact, forward, backward = height(problem)
        low, high = (height(problem, float(np.exp(sign * _SPREAD)))[0] for sign in (-1, 1))
        yield Derivative(name, exact, (high - low) / (2 * _SPREAD), forward, backward)


def _damped(problem: Problem, damping: float) -> Problem:
    return replace(problem, sheet=replace(problem.sheet, damping=damping))


def _pair(problem: Problem, what: str, against: str, one: Track, two: Track) -> Pair:
    return Pair(problem.name, what, against, problem.times, distances(one, two), two.seconds / problem.seconds)
