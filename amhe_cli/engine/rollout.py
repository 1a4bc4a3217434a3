"""The one interface to the simulator: roll out candidate parameters from given states under given inputs.

Alignment is settled here and nowhere else: row k of every array of `Rollouts` is the instant k + 1, the
state after input k; the initial state is the instant 0. MuJoCo's own rollout records sensors one step
late (they describe the state before the step); the engine shifts them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from amhe_cli.core.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Rollouts:
    """Predicted states of n rollouts; rows past a rollout's own length are meaningless.

    Args:
        qpos, qvel: States at the instants 1 .. H, shape (n, H, nq) and (n, H, nv).
        sensordata: Sensors at the same instants, shape (n, H, nsensordata); None if not asked for.
        completed: False where the simulator warned of divergence, shape (n,). Such a rollout's numbers
            look tame (MuJoCo stops, or resets, and repeats itself): never use them.
    """

    qpos: FloatArray
    qvel: FloatArray
    sensordata: FloatArray | None
    completed: BoolArray


class RolloutEngine(Protocol):
    """What a rollout engine, on CPU or GPU, must offer."""

    def rollout(
        self, theta: FloatArray, qpos: FloatArray, qvel: FloatArray, inputs: FloatArray, lengths: IntArray
    ) -> Rollouts:
        """Roll out n candidates.

        Args:
            theta: Parameters in SI units, shape (n, d).
            qpos: Initial positions, shape (n, nq).
            qvel: Initial velocities, shape (n, nv).
            inputs: Input vectors of the system's `input_spec`, held over one step, shape (n, H, nu).
            lengths: Steps wanted of each rollout, shape (n,), at most H.

        Raises:
            SimulationError: The simulator refused the model or an input.
        """
        ...
