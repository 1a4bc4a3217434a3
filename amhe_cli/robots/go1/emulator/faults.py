"""What can be made to go wrong: `loss=0.02,after=5,hot=10`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.robots.go1.link.state import Remote, RobotState


@dataclass(frozen=True, slots=True)
class Faults:
    """Shares from 0 to 1, delays [s], and when things happen [s after the motors were first driven].

    Args:
        loss, duplicate: Share of datagrams, either way.
        corrupt: Share of states that come damaged.
        delay: Delay of all datagrams, either way [s].
        after: Time at which these four begin; by default they act from the first datagram on.
        silence: States stop: the cable is pulled.
        stale: The robot's clock stands still.
        remote: Somebody presses L2 + B.
        hot, mode, battery, tilt, speed, power, nan: The robot reports this fault.
        mocap: Motion capture stops.
        frozen, frozen_box: The pose of trunk or box stays, and its times go on.
        swap: Trunk and box have each other's name; 1: from the start.
        yup: Motion capture has y upward; 1: from the start.
        high: The robot is in high-level mode; 1: from the start.
    """

    loss: float = 0.0
    duplicate: float = 0.0
    corrupt: float = 0.0
    delay: float = 0.0
    after: float = -np.inf
    silence: float = np.inf
    stale: float = np.inf
    remote: float = np.inf
    hot: float = np.inf
    mode: float = np.inf
    battery: float = np.inf
    tilt: float = np.inf
    speed: float = np.inf
    power: float = np.inf
    nan: float = np.inf
    mocap: float = np.inf
    frozen: float = np.inf
    frozen_box: float = np.inf
    swap: float = 0.0
    yup: float = 0.0
    high: float = 0.0

    def reported(self, state: RobotState, driven: float) -> RobotState:
        """The state that the robot reports, so long after its motors were first driven [s]."""
        for name, change in _TELLING.items():
            if driven >= getattr(self, name):
                state = change(state)
        return state


def parse_faults(text: str) -> Faults:
    """'loss=0.02,delay=5ms' as values; times in s, or with ms.

    Raises:
        ConfigError: An unknown name, or no number.
    """
    names = [entry.name for entry in fields(Faults)]
    given: dict[str, float] = {}
    for part in filter(None, text.split(",")):
        name, _, value = part.partition("=")
        if name not in names:
            raise ConfigError(one_of("fault", name, names))
        try:
            given[name] = 1e-3 * float(value[:-2]) if value.endswith("ms") else float(value.removesuffix("s"))
        except ValueError:
            raise ConfigError(f"`fault` {part}: write {name}=NUMBER, such as {name}=0.5") from None
    return Faults(**given)


def _one(values: FloatArray, value: float) -> FloatArray:
    changed = np.array(values)
    changed[4] = value
    return changed


_TELLING: dict[str, Callable[[RobotState], RobotState]] = {
    "remote": lambda state: replace(state, remote=Remote(frozenset({"L2", "B"})).raw()),
    "hot": lambda state: replace(state, temperatures=_one(state.temperatures, 95.0)),
    "mode": lambda state: replace(state, modes=_one(state.modes.astype(float), 8.0).astype(int)),
    "battery": lambda state: replace(state, charge=4),
    "tilt": lambda state: replace(state, quaternion=np.array([np.cos(0.6), np.sin(0.6), 0.0, 0.0])),
    "speed": lambda state: replace(state, joint_rates=_one(state.joint_rates, 40.0)),
    "power": lambda state: replace(state, joint_rates=np.full(12, 7.0), torques=np.full(12, 12.0)),
    "nan": lambda state: replace(state, joints=_one(state.joints, np.nan)),
}


@dataclass(slots=True)
class Dice:
    """Decides by chance what becomes of a datagram.

    Args:
        faults: Probabilities of loss, duplicates and damage.
        rng: The source of chance.
    """

    faults: Faults
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))

    def copies(self, datagram: bytes, inward: bool) -> list[bytes]:
        """What arrives of a datagram: nothing, itself, itself twice, or something else."""
        f = self.faults
        if not (f.loss or f.duplicate or f.corrupt):
            return [datagram]
        lost, doubled, damaged = self.rng.random(3)
        if lost < f.loss:
            return []
        if damaged < f.corrupt and not inward:
            position = int(self.rng.integers(3, 600))
            datagram = datagram[:position] + bytes([datagram[position] ^ 1]) + datagram[position + 1 :]
        return [datagram] * (2 if doubled < f.duplicate else 1)
