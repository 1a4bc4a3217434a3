"""Probing a system by its own actuators: random multisines, the best of them, its log."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from amhe_cli import __version__
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import ConfigError, Ending, SimulationError
from amhe_cli.core.log import Log
from amhe_cli.core.samples import sampled
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.design.actuators import drives_of
from amhe_cli.estimation.design.design import accuracy, criterion, ensemble
from amhe_cli.estimation.design.information import information_at
from amhe_cli.estimation.design.multisine import Multisine, candidates, slow_sine
from amhe_cli.estimation.design.plan import ProbePlan, parts_of
from amhe_cli.estimation.design.playback import Playback
from amhe_cli.estimation.design.probe import ProbeOptions, Say, believing, clips_of
from amhe_cli.logs import LogWriter
from amhe_cli.logs.messages.signal_writer import message_type, write_samples
from amhe_cli.system.edits import ModelEdits
from amhe_cli.system.model_file import compiled
from amhe_cli.system.system import System

#: The least time that is a probe [s].
_SHORTEST = 1.0


class DriveProbe:
    """See `probe.Probe`.

    Args:
        options: As given.
        folder: Of the system.
        settings: Nested overrides of it.

    Raises:
        ConfigError: A system with nothing to drive, or whose log cannot be written; a belief or a plant
            that does not suit.
    """

    def __init__(self, options: ProbeOptions, folder: Path, settings: dict[str, Any]) -> None:
        self._options, self.task = options, None
        own = System.load(folder, settings)
        self.system: System = believing(own, options.belief)
        self._drives = drives_of(own)
        for signal in own.signals:  # refuse what could not be logged before any work is done
            message_type(signal)
        self._engine = open_engine(own, threads=options.threads)
        self._model = Playback(own, self._engine, own.model.opt.timestep)
        self._plant = self._model if options.plant is None else _other(options, folder, settings)
        self._truth = own.space.named(own.space.nominal)

    def design(self, say: Say) -> ProbePlan:
        """See `Probe`."""
        options, space = self._options, self.system.space
        if options.seconds < _SHORTEST:
            raise ConfigError(f"--for {options.seconds:g}: too short; a probe takes {_SHORTEST:g} s or more")
        draws = ensemble(space, self.system.settings.probe.pairs, options.rng(0))
        tried = self._tried
        found = []
        for number, one in enumerate(tried):
            say(f"trying {one.name}, {number + 1} of {len(tried)}")
            found.append(self._told(one, draws))
        values = [-np.inf if told is None else criterion(told, space.prior_precision) for told in found]
        best = int(np.argmax(values))
        chosen, plain = found[best], found[0]
        if chosen is None:
            raise ConfigError(
                f"{self.system.name}: no excitation that was tried stays within the joints' limits"
            )
        return ProbePlan(
            parts_of([(tried[best].name, "sines within the limits of the controls", options.seconds)]),
            accuracy(space, chosen),
            None if plain is None else accuracy(space, plain),
            tried[0].name,
        )

    def run(self, plan: ProbePlan, path: Path, stopped: Callable[[], bool], say: Say) -> Ending:
        """See `Probe`; a simulation without a controller is over before anybody could stop it."""
        chosen = next(one for one in self._tried if one.name == plan.parts[0].name)
        theta = np.array([self._truth[name] for name in self.system.space.names])
        log = self._played(self._plant, chosen, theta[None], 3)[0]
        if log is None:
            return Ending(error=SimulationError("the plant diverged, or left its joints' limits"))
        about = {"system": self.system.name, "seed": str(self._options.seed), "version": __version__}
        if self._options.plant is None:
            about["truth"] = json.dumps(self._truth)
        played = [s for s in self.system.signals if all(s.key(q) in log.series for q in s.quantities)]
        with LogWriter(path, about) as file:  # stamps begin after zero, which would be no stamp
            write_samples(file, played, sampled(log), lambda time: round(1e9 * (time + log.dt)))
        return Ending()

    @property
    def _tried(self) -> list[Multisine]:
        """The plain one first."""
        limits = self._drives.rest, self._drives.lower, self._drives.upper
        count = self.system.settings.probe.candidates
        return [slow_sine(*limits), *candidates(*limits, count, self._options.rng(1))]

    def _told(self, one: Multisine, draws: FloatArray) -> FloatArray | None:
        """Information on z for each draw (e, d, d); None where one of them leaves the limits."""
        system, found = self.system, []
        for z, log in zip(
            draws, self._played(self._model, one, system.space.theta_of(draws), 2), strict=True
        ):
            if log is None:
                return None
            windows = clips_of(system, log)
            told = information_at(system, windows, self._engine, z, self._options.rng(4)) if windows else None
            found.append(np.zeros((z.size, z.size)) if told is None else told.matrix.sum(axis=0))
        return np.stack(found)

    def _played(self, playback: Playback, one: Multisine, theta: FloatArray, place: int) -> list[Log | None]:
        """What plants with parameters theta (p, d) would log."""
        swing = one.at(playback.times(self._options.seconds))
        inputs = np.tile(self._drives.home, (len(swing), 1))
        inputs[:, self._drives.columns] = swing
        everywhere = np.broadcast_to(inputs, (len(theta), *inputs.shape))
        return playback.play(theta, everywhere, self._options.rng(place))


def _other(options: ProbeOptions, folder: Path, settings: dict[str, Any]) -> Playback:
    """The plant of `--plant`: another model with the same joints and actuators, as it is."""
    assert options.plant is not None
    try:
        system = System.load(folder, settings | {"model": str(options.plant.resolve())}, warn=False)
    except ConfigError as error:
        first = str(error).splitlines()[0]
        raise ConfigError(f"--plant {options.plant}: does not suit the system: {first}") from None
    model = compiled(system.spec)
    unedited = replace(system, edits=ModelEdits(model, system.space, ()))
    engine = open_engine(unedited, threads=options.threads, model=model)
    return Playback(system, engine, model.opt.timestep)
