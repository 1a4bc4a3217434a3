"""How a log meets a model that is run backwards: the joints' efforts are compared, and the motion is given.

Efforts are those that `joints` measure, or those that would drive the model forwards, as `joint_force` or
through plain motors. What other actuators were told is of no concern.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import mujoco
import numpy as np

from amhe_cli.core.settings import Settings
from amhe_cli.system.description.data import Channel, Input
from amhe_cli.system.description.schema import Description, SignalEntry
from amhe_cli.system.description.wiring import Wiring, split_key, units_of

_CTRL = int(mujoco.mjtState.mjSTATE_CTRL)
_AT_JOINT = mujoco.mjtTrn.mjTRN_JOINT
#: Window and update period of the online estimator [s]: the smoothed motion ends before a window does.
_WINDOW, _PERIOD = 1.0, 0.5


def matching_efforts(
    file: Description, entries: Mapping[str, SignalEntry], wiring: Wiring, model: mujoco.MjModel
) -> Wiring:
    """The wiring with efforts as what is compared, and without what commands actuators.

    Args:
        file: Takes note where no signal measures an effort.
        entries: The signals.
        wiring: The wiring for rollouts.
        model: The final model.
    """
    channels = []
    for channel in wiring.channels:
        if channel.source != "sensordata":
            channels.append(replace(channel, compared=False))
        elif (dofs := _acted_on(channel, model)) is not None:
            channels.append(replace(channel, source="effort", columns=dofs))
    driven = {one.key: _driven(one, wiring.input_spec, model) for one in wiring.inputs}
    forces = {key: dofs for key, dofs in driven.items() if dofs}
    for key, dofs in forces.items():
        name, quantity = split_key(key)
        units = units_of("effort", [int(model.jnt_type[model.dof_jntid[dof]]) for dof in dofs])
        noise = entries[name].noise.get(quantity)
        channels.append(Channel(key, "linear", "effort", dofs, noise, units))
    if all(channel.source != "effort" for channel in channels):
        file.problem(
            ("match",),
            "no signal measures an effort: give joints the noise of their efforts, noise: {effort: 0.1}, or "
            "name the joints that a measured torque acts on, joint_force: [...]",
        )
    signals = tuple(
        replace(s, is_input=s.is_input and not any(s.key(q) in forces for q in s.quantities))
        for s in wiring.signals
    )
    inputs = tuple(one for one in wiring.inputs if one.key not in forces and not one.delayed)
    return Wiring(signals, tuple(channels), inputs, wiring.input_spec)


def windowed(settings: Settings) -> Settings:
    """Settings with windows that are long enough to smooth a motion in, unless they were chosen."""
    chosen = settings.mhe.model_fields_set
    longer = {"window": _WINDOW, "update_period": _PERIOD}
    mhe = settings.mhe.model_copy(update={} if "window" in chosen else longer)
    return settings.model_copy(update={"mhe": mhe})


def unpowered(wiring: Wiring, model: mujoco.MjModel) -> list[int]:
    """Actuators of joints whose force was measured, as far as nothing commands them: it was theirs, too.

    A servo would hold its joint at 0 against that force.
    """
    given = {
        dof for one in wiring.inputs if not one.delayed for dof in _driven(one, wiring.input_spec, model)
    }
    fed = {row for one in wiring.inputs for row in _actuators(one, wiring.input_spec, model)}
    return [
        row
        for row in set(range(model.nactuator)) - fed
        if model.actuator_trntype[row] == _AT_JOINT
        and int(model.jnt_dofadr[model.actuator_trnid[row, 0]]) in given
    ]


def unpowered_text(actuators: Sequence[str]) -> str:
    """What is said of such actuators."""
    several = len(actuators) > 1
    return (
        f"actuator{'s' * several} {', '.join(actuators)} {'are' if several else 'is'} off: nothing commands "
        f"{'them' if several else 'it'}, and what drove the joint{'s' * several} was measured"
    )


def _acted_on(channel: Channel, model: mujoco.MjModel) -> tuple[int, ...] | None:
    """Degrees of freedom whose actuator forces a channel measures; None of another channel."""
    kind = int(mujoco.mjtSensor.mjSENS_JOINTACTFRC)
    rows = [row for row in range(model.nsensor) if int(model.sensor_adr[row]) in channel.columns]
    if any(int(model.sensor_type[row]) != kind for row in rows):
        return None
    return tuple(int(model.jnt_dofadr[model.sensor_objid[row]]) for row in rows)


def _driven(force: Input, input_spec: int, model: mujoco.MjModel) -> tuple[int, ...]:
    """Degrees of freedom that an input acts on with its own numbers: as forces, or through plain motors."""
    rows, found = _actuators(force, input_spec, model), []
    for row in rows if not force.delayed or split_key(force.key)[1] == "effort" else ():
        size = model.actuator_gear[model.actuator_outadr[row], 0] * model.actuator_gainprm[row, 0]
        plain = (
            model.actuator_gaintype[row] == mujoco.mjtGain.mjGAIN_FIXED and not model.actuator_dyntype[row]
        )
        plain &= model.actuator_biastype[row] == mujoco.mjtBias.mjBIAS_NONE or not force.delayed
        if model.actuator_trntype[row] == _AT_JOINT and plain and size == 1.0:
            found.append(int(model.jnt_dofadr[model.actuator_trnid[row, 0]]))
    return tuple(found) if len(found) == len(force.columns) else ()


def _actuators(one: Input, input_spec: int, model: mujoco.MjModel) -> list[int]:
    """Actuators that an input feeds."""
    first = mujoco.mj_stateSize(model, input_spec & (_CTRL - 1))
    width = model.nu if input_spec & _CTRL else 0
    return [
        int(np.flatnonzero(model.actuator_ctrladr <= column - first)[-1])
        for column in one.columns
        if 0 <= column - first < width
    ]
