"""Signals that drive the model: commands, known forces, motion of mocap bodies."""

from __future__ import annotations

import mujoco
import numpy as np

from amhe_cli.core.errors import ConfigError
from amhe_cli.system.schema import SignalEntry
from amhe_cli.system.targets import id_of
from amhe_cli.system.wiring import WiringDraft, chosen, names_of_log, one_quantity, signal_of, single_joints

WRENCH = ("force", "torque")
_CTRL = mujoco.mjtState.mjSTATE_CTRL
_JOINT_FORCE = mujoco.mjtState.mjSTATE_QFRC_APPLIED
_MOCAP = {"position": mujoco.mjtState.mjSTATE_MOCAP_POS, "orientation": mujoco.mjtState.mjSTATE_MOCAP_QUAT}


def actuators(draft: WiringDraft, name: str, entry: SignalEntry) -> None:
    """Commands: controls of actuators, held until the next message."""
    own, logged = names_of_log(entry.actuators)
    rows = [id_of(draft.model, "actuator", actuator) for actuator in own]
    for row in rows:
        if draft.model.actuator_ctrlnum[row] != 1:
            raise ConfigError(f"actuator {draft.model.actuator(row).name!r} takes several controls, not one")
    usual = "value" if str(entry.type).endswith("MultiArray") else commanded(draft.model, rows[0])
    quantity = one_quantity(entry, usual)
    signal = signal_of(name, entry, (quantity,), logged, is_input=True)
    draft.driven.append((signal.key(quantity), _CTRL, list(own), True))
    draft.signals.append(signal)


def commanded(model: mujoco.MjModel, row: int) -> str:
    """What an actuator's control is: a servo's target or a motor's effort."""
    bias = model.actuator_biasprm[row]
    if int(model.actuator_biastype[row]) == mujoco.mjtBias.mjBIAS_AFFINE:
        return "position" if bias[1] else "velocity"
    return "effort"


def joint_force(draft: WiringDraft, name: str, entry: SignalEntry) -> None:
    """Known forces or torques at joints, in addition to the actuators'."""
    own, logged = names_of_log(entry.joint_force)
    rows = single_joints(draft.model, own)
    quantity = one_quantity(entry, "value" if str(entry.type).endswith("MultiArray") else "effort")
    signal = signal_of(name, entry, (quantity,), logged, is_input=True)
    columns: list[int | str] = [int(draft.model.jnt_dofadr[row]) for row in rows]
    draft.driven.append((signal.key(quantity), _JOINT_FORCE, columns, False))
    draft.signals.append(signal)


def mocap(draft: WiringDraft, name: str, entry: SignalEntry) -> None:
    """Pose of a body that is moved from outside."""
    row = int(draft.model.body_mocapid[id_of(draft.model, "body", str(entry.mocap))])
    if row < 0:
        raise ConfigError(f'body {entry.mocap!r} is no mocap body; give it mocap="true" in the model')
    signal = signal_of(name, entry, chosen(entry, tuple(_MOCAP)))
    for quantity in signal.quantities:
        width = 3 if quantity == "position" else 4
        columns: list[int | str] = list(range(width * row, width * (row + 1)))
        draft.driven.append((signal.key(quantity), _MOCAP[quantity], columns, False))
    draft.signals.append(signal)


def force_on(draft: WiringDraft, name: str, entry: SignalEntry) -> None:
    """Six actuators that act at a site: in its own frame, or in the world's if they refer to that."""
    body = str(entry.force_on)
    id_of(draft.model, "body", body)
    if entry.at is not None:
        id_of(draft.model, "site", entry.at)
    site = entry.at or draft.site_on(body)
    reference = {"refsite": draft.site_on("world")} if entry.frame == "world" else {}
    signal = signal_of(name, entry, chosen(entry, WRENCH))
    for quantity in signal.quantities:
        actuators = [f"amhe/{name}/{quantity}/{axis}" for axis in "xyz"]
        for axis, actuator in enumerate(actuators):
            gear = np.zeros(6)
            gear[axis + 3 * WRENCH.index(quantity)] = -1.0 if entry.reaction else 1.0
            draft.spec.add_actuator(
                name=actuator, trntype=mujoco.mjtTrn.mjTRN_SITE, target=site, gear=gear, **reference
            )
        draft.driven.append((signal.key(quantity), _CTRL, list(actuators), False))
    draft.signals.append(signal)
