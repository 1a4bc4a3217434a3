# type: ignore  (kernels are written in warp's own language)
"""What runs on the card beside mujoco-warp's own step: inputs in, wanted numbers out, divergence found.

A world computes rollouts of one candidate, one after the other: its queue. Where it is in its queue, and how
many steps of that rollout are done, is known on the device, so that the launches of a step never change.
"""

from __future__ import annotations

import sys

import mujoco_warp as mjw
import warp as wp

from amhe_cli.system.parameters.gear_friction import AHEAD

# nobody takes derivatives of these kernels, which would compile for as long again
for _module in (sys.modules[__name__], sys.modules[mjw.set_const.__module__]):
    wp.set_module_options({"enable_backward": False}, _module)

#: MuJoCo's own bound (mjMAXVAL): a state beyond it has diverged.
LARGEST = wp.constant(1.0e10)
LEAP = wp.constant(AHEAD)
#: What mujoco-warp has of an actuator's gain, and of its bias.
VECTOR = wp.types.vector(length=10, dtype=float)
#: Buffers that were too small; the worlds are made again with larger ones.
FULL = wp.constant(
    int(
        mjw.OverflowType.NEFC
        | mjw.OverflowType.NJMAX_NNZ
        | mjw.OverflowType.BROADPHASE
        | mjw.OverflowType.NARROWPHASE
        | mjw.OverflowType.CCD
    )
)


@wp.kernel
def take_next(
    queue: wp.array2d[int],
    place: wp.array[int],
    clock: wp.array[int],
    clip: wp.array[int],
    takes: wp.array[int],
    begins: wp.array[bool],
):
    """Mark the worlds whose rollout is over and that have another one, and go on to it. Thread (world,)."""
    world = wp.tid()
    begins[world] = False
    at = place[world]
    over = at < 0 or clock[world] >= takes[clip[queue[world, wp.max(at, 0)]]]
    following = wp.min(at + 1, queue.shape[1] - 1)
    if not over or following == at or queue[world, following] < 0:
        return
    place[world] = following
    clock[world] = 0
    begins[world] = True


@wp.kernel
def begin(
    queue: wp.array2d[int],
    place: wp.array[int],
    begins: wp.array[bool],
    first_qpos: wp.array2d[float],
    first_qvel: wp.array2d[float],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
):
    """First states of the worlds that begin a rollout. Thread (world,)."""
    world = wp.tid()
    if not begins[world]:
        return
    rollout = queue[world, place[world]]
    for i in range(qpos.shape[1]):
        qpos[world, i] = first_qpos[rollout, i]
    for i in range(qvel.shape[1]):
        qvel[world, i] = first_qvel[rollout, i]


@wp.kernel
def write_inputs(
    queue: wp.array2d[int],
    place: wp.array[int],
    clock: wp.array[int],
    clip: wp.array[int],
    inputs: wp.array3d[float],
    candidate: wp.array[int],
    whole: wp.array2d[int],
    fraction: wp.array2d[float],
    history: int,
    first: int,
    into: wp.array2d[float],
):
    """Inputs of this step; the last is held for the sensors' extra step. Thread (world, column)."""
    world, column = wp.tid()
    c = clip[queue[world, place[world]]]
    j = first + column
    last = inputs.shape[1] - 1
    p = candidate[world]
    part = fraction[p, j]
    late = wp.min(history + clock[world], last) - whole[p, j]
    value = inputs[c, wp.clamp(late, 0, last), j]
    if part > 0.0:
        value = (1.0 - part) * value + part * inputs[c, wp.clamp(late - 1, 0, last), j]
    into[world, column] = value


@wp.kernel
def hold_dry(begins: wp.array[bool], dry: wp.array2d[float], holds: wp.array2d[float]):
    """Worlds that begin a rollout have their dry friction alone. Thread (world, dof)."""
    world, dof = wp.tid()
    if begins[world]:
        holds[world, dof] = dry[world, dof]


@wp.func
def under_load(k_e: float, external: float, k_m: float, motor: float):
    """As `gear_friction` has it."""
    sign = wp.sign(k_e * wp.abs(external) + k_m * wp.abs(motor))
    return sign * wp.abs(k_e * external - k_m * motor)


@wp.kernel
def hold(
    clock: wp.array[int],
    every: int,
    begins: wp.array[bool],
    dofs: wp.array[int],
    numbers: wp.array3d[float],
    dry: wp.array2d[float],
    qfrc_actuator: wp.array2d[float],
    qfrc_damper: wp.array2d[float],
    qfrc_smooth: wp.array2d[float],
    qfrc_constraint: wp.array2d[float],
    qvel: wp.array2d[float],
    before: wp.array2d[float],
    holds: wp.array2d[float],
):
    """What friction can hold, as `GearFriction.bound` and `ahead` have it. Thread (world, joint).

    It is set before every so many steps; with 0, in the worlds that begin a rollout.
    """
    world, joint = wp.tid()
    dof = dofs[joint]
    if every == 0:
        if not begins[world]:
            return
    elif (clock[world] + 1) % every != 0:
        return
    constraint = qfrc_constraint[world, dof]
    motor = qfrc_actuator[world, dof]
    contact = wp.sign(constraint) * wp.max(wp.abs(constraint) - holds[world, dof], 0.0)
    external = qfrc_smooth[world, dof] - qfrc_damper[world, dof] - motor + contact
    slow = wp.exp(-wp.pow(wp.abs(qvel[world, dof] / numbers[world, joint, 3]), numbers[world, joint, 4]))
    found = dry[world, dof] + under_load(numbers[world, joint, 1], external, numbers[world, joint, 0], motor)
    stuck = under_load(numbers[world, joint, 6], external, numbers[world, joint, 5], motor)
    found += slow * (numbers[world, joint, 2] + stuck)
    found += numbers[world, joint, 7] * wp.max(-motor * external, 0.0)
    now = wp.max(found, 0.0)
    if every == 0:
        holds[world, dof] = now
    else:
        line = now + (now - before[world, joint]) * (0.5 + 0.5 / float(every))
        holds[world, dof] = wp.clamp(line, now / LEAP, now * LEAP)
    before[world, joint] = now


@wp.kernel
def drive(
    places: wp.array2d[int],
    numbers: wp.array3d[float],
    limited: wp.array[bool],
    ctrlrange: wp.array2d[wp.vec2],
    gear: wp.array[float],
    gainprm: wp.array2d[VECTOR],
    forcerange: wp.array2d[wp.vec2],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    ctrl: wp.array2d[float],
    biasprm: wp.array2d[VECTOR],
):
    """What a servo's torque is beyond its gains, as `Servos.law` has it. Thread (world, servo)."""
    world, servo = wp.tid()
    row = places[servo, 0]
    control = places[servo, 3]
    volts = places[servo, 4]
    enabled = places[servo, 5]
    command = ctrl[world, control]
    if limited[control]:
        within = ctrlrange[world % ctrlrange.shape[0], control]
        command = wp.clamp(command, within[0], within[1])
    gain = gainprm[world % gainprm.shape[0], row][0]
    limit = forcerange[world % forcerange.shape[0], row][1]
    bias = biasprm[world, row]
    speed = gear[servo] * qvel[world, places[servo, 2]]
    alone = gain * command + bias[1] * gear[servo] * qpos[world, places[servo, 1]] + bias[2] * speed
    duty = wp.min(wp.max(wp.abs(alone) / limit, numbers[world, servo, 0]), 1.0)
    if wp.abs(alone) <= gain * numbers[world, servo, 1]:
        duty = 0.0
    driven = limit * duty * wp.where(alone < 0.0, -1.0, 1.0)
    if volts >= 0:
        driven *= ctrl[world, volts] / numbers[world, servo, 4]
    given = (driven - numbers[world, servo, 3] * speed) / (1.0 + numbers[world, servo, 2] * duty * duty)
    if enabled >= 0:
        given *= wp.where(ctrl[world, enabled] == 0.0, 0.0, 1.0)
    bias[0] = given - alone
    biasprm[world, row] = bias


@wp.kernel
def watch(
    queue: wp.array2d[int],
    place: wp.array[int],
    clock: wp.array[int],
    clip: wp.array[int],
    lengths: wp.array[int],
    overflow: wp.array[int],
    home: wp.array2d[float],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    act: wp.array2d[float],
    qacc_warmstart: wp.array2d[float],
    completed: wp.array[int],
    full: wp.array[int],
):
    """Count a step, mark rollouts without room, and those that diverge. Thread (world,).

    Worlds that diverged go home, where they cost no time.
    """
    world = wp.tid()
    rollout = queue[world, place[world]]
    step = clock[world]
    clock[world] = step + 1
    if overflow[world] & FULL != 0:
        full[rollout] = 1
    bad = wp.int32(0)  # a plain 0 would be a constant, which no loop may change
    for i in range(qpos.shape[1]):
        bad += wp.where(wp.abs(qpos[world, i]) < LARGEST, 0, 1)  # 1 for NaN, too
    for i in range(qvel.shape[1]):
        bad += wp.where(wp.abs(qvel[world, i]) < LARGEST, 0, 1)
        bad += wp.where(wp.abs(qacc_warmstart[world, i]) < LARGEST, 0, 1)
    if bad == 0:
        return
    if step < lengths[clip[rollout]]:
        completed[rollout] = 0
    for i in range(qpos.shape[1]):
        qpos[world, i] = home[world % home.shape[0], i]
    for i in range(qvel.shape[1]):
        qvel[world, i] = 0.0
        qacc_warmstart[world, i] = 0.0
    for i in range(act.shape[1]):
        act[world, i] = 0.0


@wp.kernel
def record(
    queue: wp.array2d[int],
    place: wp.array[int],
    clock: wp.array[int],
    clip: wp.array[int],
    lag: int,
    source: wp.array2d[float],
    columns: wp.array[int],
    first: wp.array2d[int],
    order: wp.array2d[int],
    into: wp.array3d[wp.float64],
):
    """Copy the samples that lie at this instant, `lag` steps before the clock. Thread (world, column)."""
    world, column = wp.tid()
    row = clock[world] - lag
    if row < 0 or row + 1 >= first.shape[1]:
        return
    rollout = queue[world, place[world]]
    c = clip[rollout]
    for i in range(first[c, row], first[c, row + 1]):
        into[rollout, order[c, i], column] = wp.float64(source[world, columns[column]])
