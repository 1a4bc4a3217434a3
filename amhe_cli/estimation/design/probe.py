"""A probe: the excitation that reveals most about the parameters is found, and recorded as a log.

`Probe` is what every kind of probe can do. `ActuatorProbe` drives a system's own actuators.
"""

from __future__ import annotations

import json
import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from amhe_cli import __version__
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.belief import Belief, with_prior
from amhe_cli.core.errors import AmheError, ConfigError, Ending, EstimationError, SimulationError
from amhe_cli.core.log import Log, sampled
from amhe_cli.core.settings import Settings
from amhe_cli.engine.bounds import Bounds, Broken, home_within
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.design.design import Accuracy, ProbePlan, accuracy, criterion, ensemble, parts_of
from amhe_cli.estimation.design.information import (
    clips_of,
    information_at,
    information_where_it_points,
    problem_of,
)
from amhe_cli.estimation.design.playback import Excitation, Playback, write_log
from amhe_cli.estimation.design.recipes import Recipe, driven_controls, leeway_of, plain, recipes
from amhe_cli.logs import read_log
from amhe_cli.logs.messages.writer import message_type
from amhe_cli.system.model.elements import driven_joint
from amhe_cli.system.model.files import compiled
from amhe_cli.system.parameters.edits import DELAYS
from amhe_cli.system.parameters.model_edits import ModelEdits
from amhe_cli.system.system import System

logger = logging.getLogger(__name__)

#: Length of the shortest probe [s].
_SHORTEST = 1.0

#: Takes one line about the progress of a design.
Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class ProbeOptions:
    """A request for a probe.

    Args:
        system: Name or folder of the system; None: `go1_push`.
        task: Task with the box and floor to probe, for `go1_push`; None: t1.
        seconds: Greatest length of the probe [s].
        belief: A belief, or its file, that replaces the system's prior.
        plant: Model that is probed in simulation instead of the system's own, or name of another Go1.
        box: Mass [kg] and friction of the box that is probed in simulation; None: the task's.
        seed: Seed of all random draws.
        threads: Threads of the rollouts; the outcome does not depend on them.
        settings: Settings that replace the system's own, as a nested mapping.
        schema: Class of the settings, for systems other than `go1_push`.
        fix, only, belief_anyway: See `System.starting_from`.
        engine: What computes the rollouts: one of `engine.open.KINDS`.
        recipe: One of `recipes.RECIPES`, for actuators that are driven as they are; None: multisines.
        speed: Largest speed of a joint that is driven as it is [rad/s or m/s]; None: `probe.speed`.
        rate: Commands a second [Hz]; None: `probe.rate`.
    """

    system: str | None = None
    task: str | None = None
    seconds: float = 10.0
    belief: Belief | Path | None = None
    plant: str | Path | None = None
    box: tuple[float, float] | None = None
    seed: int = 0
    threads: int = 1
    settings: Mapping[str, Any] = field(default_factory=dict)
    schema: type[Settings] = Settings
    fix: Mapping[str, float] = field(default_factory=dict)
    only: Sequence[str] | None = None
    belief_anyway: bool = False
    engine: str = "cpu"
    recipe: str | None = None
    speed: float | None = None
    rate: float | None = None

    def rng(self, *place: int) -> np.random.Generator:
        """A generator of its own for each use."""
        return np.random.default_rng([self.seed, *place])


class Probe(Protocol):
    """A system that can be probed."""

    @property
    def system(self) -> System:
        """The system, with the belief as its prior."""
        ...

    @property
    def task(self) -> str | None:
        """Name of the task with the box that is probed; None where the system has no tasks."""
        ...

    def design(self, say: Say) -> ProbePlan:
        """Find the excitation that reveals most about the parameters.

        Raises:
            ConfigError: The time is too short for any excitation.
        """
        ...

    def run(self, plan: ProbePlan, path: Path, stopped: Callable[[], bool], say: Say) -> Ending:
        """Run the plan and write its log."""
        ...


def believing(system: System, options: ProbeOptions) -> System:
    """The system that a probe is about: with the belief as its prior, and some parameters fixed.

    Raises:
        ConfigError: The belief does not suit, or a parameter cannot be fixed so.
    """
    system, belief = system.starting_from(
        options.belief, fix=options.fix, only=options.only, belief_anyway=options.belief_anyway
    )
    return system if belief is None else replace(system, space=with_prior(system.space, belief))


def achieved(system: System, path: Path, options: ProbeOptions) -> Accuracy | None:
    """How well the parameters are known from a log and the prior; None where that cannot be computed."""
    try:
        windows = clips_of(system, read_log(path, system))
        if not windows:
            raise EstimationError("nothing moves in it")
        engine, rng = open_engine(system, threads=options.threads, kind=options.engine), options.rng(9)
        found = information_where_it_points(problem_of(system, windows, engine), rng)
    except AmheError as error:  # the log is worth more than a number computed from it
        logger.warning(f"what the log reveals cannot be computed: {error}")
        return None
    return accuracy(system.space, found[None])


class ActuatorProbe:
    """A probe by the system's own actuators: the best of some random recipes.

    Args:
        options: The request.
        own: The system.

    Raises:
        ConfigError: The system has nothing to drive, its log cannot be written, or a belief, plant or setting
            does not suit.
    """

    def __init__(self, options: ProbeOptions, own: System) -> None:
        self._options, self.task = options, None
        self.system: System = believing(own, options)
        truth = own.space.named(own.space.nominal) | self.system.fixed
        own = self.system
        self._controls = driven_controls(own)
        home_within(own)
        for signal in own.signals:  # refuse what could not be logged before any work is done
            if not signal.columns:
                message_type(signal)
        self._engine = open_engine(own, threads=options.threads, kind=options.engine)
        usual = own.settings.probe
        self._leeway = leeway_of(own, self._controls, options.speed or usual.speed)
        bounds = Bounds(own, tuple(self._controls.actuators.tolist()), self._leeway.fastest)
        period = 1.0 / (options.rate or usual.rate)
        self._model = Playback(own, self._engine, own.model.opt.timestep, period, bounds)
        self._plant = self._model
        if options.plant is not None:
            self._plant = _other_plant(options, own, Path(options.plant), period)
        self._truth = truth

    def design(self, say: Say) -> ProbePlan:
        """See `Probe`."""
        options, space = self._options, self.system.space
        if options.seconds < _SHORTEST:
            raise ConfigError(
                f"`seconds` {options.seconds:g}: too short; a probe takes {_SHORTEST:g} s or more"
            )
        draws = ensemble(space, self.system.settings.probe.pairs, options.rng(0))
        tried, found, broken = list(self._motions), list[FloatArray | None](), Counter[Broken]()
        for number, one in enumerate(tried):
            say(f"trying {one.name}, {number + 1} of {len(tried)}")
            own = self._information(one, draws)
            while isinstance(own, Broken):
                broken[own] += 1
                if (less := tried[number].smaller(own.joint)) is None:
                    break
                tried[number], own = less, self._information(less, draws)
            found.append(None if isinstance(own, Broken) else own)
        values = [-np.inf if own is None else criterion(own, space.prior_precision) for own in found]
        best = 1 + int(np.argmax(values[1:]))
        chosen, simple = found[best], found[0]
        if chosen is None:
            raise ConfigError(f"{self.system.name}: {nothing_left(broken)}")
        self._chosen = tried[best]
        prior = float(np.linalg.slogdet(space.prior_precision)[1])
        left = np.exp((prior - np.array(values)) / (2.0 * len(space)))
        return ProbePlan(
            parts_of([(self._chosen.name, self._chosen.title, options.seconds)]),
            accuracy(space, chosen),
            None if simple is None else accuracy(space, simple),
            tried[0].name,
            tuple((one.name, float(sd)) for one, sd in zip(tried, left, strict=True) if np.isfinite(sd)),
        )

    def excitation(self) -> Excitation:
        """The commands that `design` has chosen, for a robot's own program to play."""
        times = self._model.times(self._options.seconds)
        driven = {one.key for one in self.system.inputs if one.delayed}
        signals = [s for s in self.system.signals if driven & {s.key(q) for q in s.quantities}]
        model, rows = self.system.model, self._controls.actuators.tolist()
        return Excitation(
            times,
            self._chosen.at(times),
            tuple(signals),
            joints=tuple(driven_joint(model, row) or model.actuator(row).name for row in rows),
            actuators=tuple(model.actuator(row).name for row in rows),
        )

    def run(self, plan: ProbePlan, path: Path, stopped: Callable[[], bool], say: Say) -> Ending:
        """See `Probe`; a simulation without a controller is over before anybody could stop it."""
        theta = np.array([self._truth[name] for name in self.system.space.names])
        log = self._played(self._plant, self._chosen, theta[None], 3)[0]
        if isinstance(log, Broken):
            return Ending(error=SimulationError(f"the plant breaks a bound: {log.text}"))
        about = {"system": self.system.name, "seed": str(self._options.seed), "version": __version__}
        if self._options.plant is None:
            about["truth"] = json.dumps(self._truth)
        played = [s for s in self.system.signals if all(s.key(q) in log.series for q in s.quantities)]
        write_log(path, played, sampled(log), about, log.dt)  # a stamp of zero would mean: none
        return Ending()

    @cached_property
    def _motions(self) -> Sequence[Recipe]:
        """All excitations to choose from, after the plain one."""
        kind, count = self._options.recipe or "multisine", self.system.settings.probe.candidates
        return [plain(self._leeway), *recipes(kind, self._leeway, count, self._options.seed)]

    def _information(self, one: Recipe, draws: FloatArray) -> FloatArray | Broken:
        """Information on z for each draw, shape (e, d, d), or what one of them breaks."""
        system, found, whole = self.system, [], None
        logs = self._played(self._model, one, system.space.theta_of(draws), 2)
        for z, log in zip(draws, logs, strict=True):
            if isinstance(log, Broken):
                return log
            matrix, windows = np.zeros((z.size, z.size)), clips_of(system, log)
            if windows:
                problem = replace(problem_of(system, windows, self._engine), whole=whole)
                whole = whole or problem  # what moves what is the same
                matrix = information_at(problem, z, self._options.rng(4)).matrix.sum(axis=0)
            found.append(matrix)
        return np.stack(found)

    def _played(self, playback: Playback, one: Recipe, theta: FloatArray, place: int) -> list[Log | Broken]:
        """The logs of plants with parameters theta (p, d)."""
        swing = one.at(playback.times(self._options.seconds))
        inputs = np.tile(self._controls.home, (len(swing), 1))
        inputs[:, self._controls.columns] = swing
        everywhere = np.broadcast_to(inputs, (len(theta), *inputs.shape))
        return playback.play(theta, everywhere, self._options.rng(place))


def nothing_left(broken: Counter[Broken]) -> str:
    """Why no excitation is left, and what helps."""
    usual = [
        f"{one.text} ({'once' if count == 1 else f'{count} times'})" + f": {one.advice}" * bool(one.advice)
        for one, count in broken.most_common(3)
    ]
    return f"every excitation that was tried breaks a bound: {'; '.join(usual)}"


def _other_plant(options: ProbeOptions, own: System, plant: Path, period: float) -> Playback:
    """Another model with the same joints and actuators, with its own parameters."""
    assert own.folder is not None, "only systems with a folder are probed by another plant"
    try:
        system = System.load(own.folder, {**options.settings, "model": str(plant.resolve())}, warn=False)
    except ConfigError as error:
        first = str(error).splitlines()[0]
        raise ConfigError(f"`plant` {plant}: does not suit the system: {first}") from None
    model = compiled(system.spec)
    at_once = {DELAYS: np.zeros(system.edits.delays(own.space.nominal[None]).shape[1])}
    unedited = replace(system, edits=ModelEdits(model, own.space, (), at_once))
    engine = open_engine(unedited, threads=options.threads, kind=options.engine, model=model)
    return Playback(replace(system, edits=unedited.edits), engine, model.opt.timestep, period)
