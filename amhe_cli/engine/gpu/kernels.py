# type: ignore  (kernels are written in warp's own language)
"""What runs on the card beside mujoco-warp's own step: inputs in, wanted numbers out, divergence found.

One clock counts the steps on the device, so that the launches of a step never change.
"""

from __future__ import annotations

import warp as wp

#: MuJoCo's own bound (mjMAXVAL): a state beyond it has diverged.
LARGEST = wp.constant(1.0e10)


@wp.kernel
def write_inputs(
    clock: wp.array[int],
    inputs: wp.array3d[float],
    candidate: wp.array[int],
    clip: wp.array[int],
    whole: wp.array2d[int],
    fraction: wp.array2d[float],
    history: int,
    first: int,
    into: wp.array2d[float],
):
    """Inputs of this step; the last is held for the sensors' extra step. Thread (world, column)."""
    world, column = wp.tid()
    c = clip[world]
    j = first + column
    last = inputs.shape[1] - 1
    p = candidate[world]
    part = fraction[p, j]
    late = wp.min(history + clock[0], last) - whole[p, j]
    value = inputs[c, wp.clamp(late, 0, last), j]
    if part > 0.0:
        value = (1.0 - part) * value + part * inputs[c, wp.clamp(late - 1, 0, last), j]
    into[world, column] = value


@wp.kernel
def watch(
    clock: wp.array[int],
    clip: wp.array[int],
    lengths: wp.array[int],
    home: wp.array2d[float],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    act: wp.array2d[float],
    qacc_warmstart: wp.array2d[float],
    completed: wp.array[int],
):
    """Mark a world that diverged and send it home, where it costs no time. Thread (world,)."""
    world = wp.tid()
    bad = wp.int32(0)  # a plain 0 would be a constant, which no loop may change
    for i in range(qpos.shape[1]):
        bad += wp.where(wp.abs(qpos[world, i]) < LARGEST, 0, 1)  # 1 for NaN, too
    for i in range(qvel.shape[1]):
        bad += wp.where(wp.abs(qvel[world, i]) < LARGEST, 0, 1)
        bad += wp.where(wp.abs(qacc_warmstart[world, i]) < LARGEST, 0, 1)
    if bad == 0:
        return
    if clock[0] < lengths[clip[world]]:
        completed[world] = 0
    for i in range(qpos.shape[1]):
        qpos[world, i] = home[world % home.shape[0], i]
    for i in range(qvel.shape[1]):
        qvel[world, i] = 0.0
        qacc_warmstart[world, i] = 0.0
    for i in range(act.shape[1]):
        act[world, i] = 0.0


@wp.kernel
def record(
    clock: wp.array[int],
    lag: int,
    source: wp.array2d[float],
    columns: wp.array[int],
    clip: wp.array[int],
    first: wp.array2d[int],
    order: wp.array2d[int],
    into: wp.array3d[wp.float64],
):
    """Copy the samples that lie at this instant, `lag` steps before the clock. Thread (world, column)."""
    world, column = wp.tid()
    row = clock[0] - lag
    if row < 0 or row + 1 >= first.shape[1]:
        return
    c = clip[world]
    for i in range(first[c, row], first[c, row + 1]):
        into[world, order[c, i], column] = wp.float64(source[world, columns[column]])


@wp.kernel
def tick(clock: wp.array[int]):
    """Count one step. One thread."""
    clock[0] = clock[0] + 1
