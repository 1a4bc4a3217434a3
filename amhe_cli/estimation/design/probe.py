"""What the two kinds of probe have in common: what is asked for, what they do, what a log told."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from amhe_cli.assembly import LogSource, trajectories
from amhe_cli.core.belief_file import read_belief
from amhe_cli.core.errors import AmheError, Ending, EstimationError
from amhe_cli.core.log import Log, Window
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.design.design import Accuracy, accuracy
from amhe_cli.estimation.design.information import information_where_it_points
from amhe_cli.estimation.design.plan import ProbePlan
from amhe_cli.estimation.offline.clips import ClipPool, whole
from amhe_cli.system.system import System

logger = logging.getLogger(__name__)

#: Told how far a design is.
Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class ProbeOptions:
    """What the user asked `amhe probe` for.

    Args:
        system: Name or folder; None: `go1_push`.
        task: Whose box and floor are probed, where the system has tasks; None: those of t1.
        seconds: The longest that the probe may take [s].
        belief: File of a belief to design with, in place of the system's prior.
        plant: Model that is probed in place of the system's own.
        box: Mass [kg] and friction of the box that is probed in simulation; None: the task's.
        seed: Of every random draw.
        threads: Of the rollouts; the outcome does not depend on it.
        assignments, config: Settings, as everywhere.
    """

    system: str | None = None
    task: str | None = None
    seconds: float = 10.0
    belief: Path | None = None
    plant: Path | None = None
    box: tuple[float, float] | None = None
    seed: int = 0
    threads: int = 1
    assignments: tuple[str, ...] = ()
    config: Path | None = None

    def rng(self, *place: int) -> np.random.Generator:
        """A generator of its own for each use."""
        return np.random.default_rng([self.seed, *place])


class Probe(Protocol):
    """A system that can be probed."""

    @property
    def system(self) -> System:
        """With what is believed as its prior."""
        ...

    @property
    def task(self) -> str | None:
        """Whose box is probed, where the system has tasks."""
        ...

    def design(self, say: Say) -> ProbePlan:
        """Find the best excitation.

        Raises:
            ConfigError: There is not time enough for any.
        """
        ...

    def run(self, plan: ProbePlan, path: Path, stopped: Callable[[], bool], say: Say) -> Ending:
        """Do it, and write the log."""
        ...


def believing(system: System, belief: Path | None) -> System:
    """A system whose prior is a belief's, where there is one.

    Raises:
        ConfigError: The belief does not suit.
    """
    return replace(system, space=system.space.with_prior(read_belief(belief, system))) if belief else system


def read(system: System, path: Path) -> Log:
    """A log that was just written."""
    return trajectories(system, LogSource((path,), {}, None, None, None))[0]


def clips_of(system: System, log: Log) -> list[Window]:
    """Windows of a log side by side, as `amhe identify` cuts them; none where nothing moves."""
    clips = system.settings.clips
    return ClipPool(system, [whole(log)], clips).cut(0.5 * sum(clips.length))


def achieved(system: System, path: Path, options: ProbeOptions) -> Accuracy | None:
    """How well the parameters are known from a log and the prior; None where it cannot be said."""
    try:
        windows = clips_of(system, read(system, path))
        if not windows:
            raise EstimationError("nothing moves in it")
        engine, rng = open_engine(system, threads=options.threads), options.rng(9)
        found = information_where_it_points(system, windows, engine, rng)
    except AmheError as error:  # the log is worth more than our word on it
        logger.warning(f"what the log tells cannot be said: {error}")
        return None
    return accuracy(system.space, found[None])
