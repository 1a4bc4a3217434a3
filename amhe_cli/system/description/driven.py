"""Signals that drive the model: commands, known forces, motion of mocap bodies."""

from __future__ import annotations

import mujoco
import numpy as np

from amhe_cli.core.errors import ConfigError
from amhe_cli.system.description.schema import SignalEntry
from amhe_cli.system.description.targets import id_of
from amhe_cli.system.description.wiring import (
    Drive,
    WiringDraft,
    chosen,
    control_of,
    inputs_of,
    names_of_log,
    one_quantity,
    signal_of,
    single_joints,
)

WRENCH = ("force", "torque")
_CTRL = mujoco.mjtState.mjSTATE_CTRL
_JOINT_FORCE = mujoco.mjtState.mjSTATE_QFRC_APPLIED
_MOCAP = {"position": mujoco.mjtState.mjSTATE_MOCAP_POS, "orientation": mujoco.mjtState.mjSTATE_MOCAP_QUAT}


def actuators(draft: WiringDraft, name: str, entry: SignalEntry) -> None:
    """Commands: controls of actuators, held until the next message."""
    own, logged = names_of_log(entry.actuators)
    rows = [id_of(draft.model, "actuator", actuator) for actuator in own]
    usual = "value" if str(entry.type).endswith("MultiArray") else commanded(draft.model, rows[0])
    quantity = one_quantity(entry, usual)
    for row in rows:
        control_of(draft.model, row, quantity)  # refused where there is none
    signal = signal_of(name, entry, (quantity,), logged, is_input=True)
    draft.driven.append(Drive(signal.key(quantity), _CTRL, list(own), delayed=True))
    draft.signals.append(signal)


def commanded(model: mujoco.MjModel, row: int) -> str:
    """What an actuator's control is: a servo's target or a motor's effort."""
    if inputs := inputs_of(model, row):
        return inputs[0]
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
    draft.driven.append(Drive(signal.key(quantity), _JOINT_FORCE, columns))
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
        frame = tuple(entry.frame) if isinstance(entry.frame, list) else ()
        draft.driven.append(Drive(signal.key(quantity), _MOCAP[quantity], columns, frame=frame))
    draft.signals.append(signal)


def force_on(draft: WiringDraft, name: str, entry: SignalEntry) -> None:
    """Six actuators that act at a site: in its own frame, or in the world's if they refer to that."""
    body = str(entry.force_on)
    id_of(draft.model, "body", body)
    moving = entry.at in draft.entries
    if entry.at is not None and not moving:
        id_of(draft.model, "site", entry.at)
    site = draft.site_on(body) if entry.at is None or moving else entry.at
    reference = {} if entry.frame == "body" else {"refsite": draft.site_on("world", entry.frame)}
    signal = signal_of(name, entry, chosen(entry, WRENCH))
    drives: list[tuple[str, str, tuple[str, str | None] | None]] = [(q, q, None) for q in signal.quantities]
    if moving:
        drives.append(("force", "torque", _arm(draft, entry)))
    for quantity, acts_as, arm in drives:
        label = quantity if acts_as == quantity else "moment"
        actuators = [f"amhe/{name}/{label}/{axis}" for axis in "xyz"]
        for axis, actuator in enumerate(actuators):
            gear = np.zeros(6)
            gear[axis + 3 * WRENCH.index(acts_as)] = -1.0 if entry.reaction else 1.0
            draft.spec.add_actuator(
                name=actuator,
                trntype=mujoco.mjtTrn.mjTRN_SITE,
                target=site,
                gear=gear,
                biastype=mujoco.mjtBias.mjBIAS_AFFINE,  # a bias of the log's numbers acts through it
                **reference,
            )
        draft.driven.append(Drive(signal.key(quantity), _CTRL, list(actuators), arm=arm))
    draft.signals.append(signal)


def _arm(draft: WiringDraft, entry: SignalEntry) -> tuple[str, str | None]:
    """Series of the point where a force acts, and of the origin of the body that it acts on.

    The origin is where the log has the body, not where a rollout does: their difference is the residual.
    """
    point = str(entry.at)
    if draft.entries[point].kind is not None or draft.entries[point].quantity != "position":
        raise ConfigError(f"at: the signal {point!r} must be only read, with quantity: position")
    if "force" not in chosen(entry, WRENCH) or entry.scale is not None or entry.bias:
        raise ConfigError("at: a moving point needs the force, without scale and bias")
    if entry.frame == "body":
        return f"{point}.position", None
    if entry.frame not in (None, "world"):
        raise ConfigError("at: a moving point is in the world or in the body's frame")
    poses = [key for key, one in draft.entries.items() if one.body == entry.force_on]
    if not poses:
        raise ConfigError(f"at: a moving point needs a signal of the body too: body: {entry.force_on}")
    return f"{point}.position", f"{poses[0]}.position"


def driven_joint(model: mujoco.MjModel, actuator: int) -> str | None:
    """Name of the joint that an actuator drives; None where it drives something else, or a nameless one."""
    at_joint = {int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)}
    if int(model.actuator_trntype[actuator]) not in at_joint:
        return None
    return model.joint(int(model.actuator_trnid[actuator, 0])).name or None
