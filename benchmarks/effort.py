"""Matching efforts on simulated logs of an arm with seven joints: error, intervals, bias and time.

    python benchmarks/effort.py [--seeds 40] [--quick] [--held-out]

Joints follow sums of sines; torques are those of the true model by `mj_inverse`, with dry friction that has
the sign of the velocity, and noise. Truths are drawn from the prior. The Cramer-Rao bound takes the motion as
known exactly. Plain least squares has the same regressor, motion and filter, each sample alike, and no prior.

With --held-out, the measured torques of the last fifth of a log, which was not fitted, against those of the
model as given, of plain least squares, and of amhe: on `example:arm_torque`, whose model `init` makes, and on
one log of the arm above.
"""

from __future__ import annotations

import argparse
import functools
import logging
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from common import PROJECT, over_seeds, show

import amhe_cli as amhe
from amhe_cli.api.identify import identify
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.log import Log, Window
from amhe_cli.engine.inverse import body_slopes, forces_along
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.offline.clips import whole
from amhe_cli.init.folder import init_system
from amhe_cli.matching import efforts
from amhe_cli.matching import motion as measured
from amhe_cli.matching.cost import MatchingCost
from amhe_cli.system.system import System

DT, SECONDS, EVERY = 0.001, 20.0, 10
TORQUE = np.array([0.5, 0.5, 0.4, 0.4, 0.2, 0.2, 0.1])
#: Joint frames along the arm: place, roll; link: mass, centre, half lengths of a box of its inertia.
LINKS = (
    ((0, 0, 0.33), 0.0, 4.0, (0.0, -0.03, -0.12), (0.06, 0.06, 0.12)),
    ((0, 0, 0), -90.0, 3.5, (0.0, -0.08, 0.03), (0.06, 0.12, 0.06)),
    ((0, -0.32, 0), 90.0, 3.2, (0.04, 0.03, -0.06), (0.06, 0.06, 0.1)),
    ((0.08, 0, 0), 90.0, 3.0, (-0.04, 0.05, 0.03), (0.07, 0.1, 0.06)),
    ((-0.08, 0.38, 0), -90.0, 2.8, (0.0, 0.04, -0.11), (0.05, 0.05, 0.13)),
    ((0, 0, 0), 90.0, 1.6, (0.05, 0.01, 0.0), (0.07, 0.05, 0.05)),
    ((0.09, 0, 0), 90.0, 0.9, (0.01, 0.01, 0.08), (0.05, 0.05, 0.05)),
)


def arm() -> mujoco.MjSpec:
    """The arm; its joints are j1 .. j7, its links link1 .. link7."""
    spec = mujoco.MjSpec()
    spec.option.timestep = DT
    body = spec.worldbody
    for i, (place, roll, mass, centre, half) in enumerate(LINKS, 1):
        turn = np.deg2rad(roll) / 2.0
        body = body.add_body(name=f"link{i}", pos=place, quat=[np.cos(turn), np.sin(turn), 0.0, 0.0])
        square = np.array(half) ** 2
        body.explicitinertial, body.mass, body.ipos = True, mass, np.array(centre)
        body.inertia = mass / 3.0 * (square.sum() - square)
        body.add_joint(
            name=f"j{i}",
            axis=[0, 0, 1],
            damping=[0.8, 0, 0],
            frictionloss=0.6 if i < 5 else 0.3,
            armature=0.1,
        )
    return spec


def unknowns() -> dict[str, Any]:
    """60 of them: masses and centres of the first four links, all ten numbers of the last three, friction."""
    found: dict[str, Any] = {}
    for i in range(1, 8):
        if i < 5:
            found[f"m{i}"] = {"targets": [{"set": "mass", "body": f"link{i}"}], "prior_sd": 0.3}
            for axis in "xyz":
                target = {"set": "center_of_mass", "body": f"link{i}", "axis": axis}
                at = LINKS[i - 1][3]["xyz".index(axis)]
                found[f"c{i}{axis}"] = {"targets": [target], "prior_sd": 0.03, "bounds": [at - 0.1, at + 0.1]}
        else:
            found[f"b{i}"] = {"targets": [{"set": "pseudo_inertia", "body": f"link{i}"}], "prior_sd": 0.3}
        for word in ("damping", "friction_loss"):
            found[f"{word}{i}"] = {"targets": [{"set": word, "joint": f"j{i}"}], "prior_sd": 0.5}
    return found


def system_of(noise: float) -> System:
    """The system, with noise of the positions [rad]."""
    joints = [f"j{i}" for i in range(1, 8)]
    return System.from_model(
        arm(),
        parameters=unknowns(),
        signals={
            "joints": {"joints": joints, "noise": {"position": noise}},
            "torque": {"joint_force": joints, "noise": {"effort": float(TORQUE.mean())}},
        },
        match="effort",
        settings={"identify": {"assumed": 0}, "clips": {"held_out": 0.0}},
    )


def motion(rng: np.random.Generator, t: FloatArray, joints: int = 7) -> list[FloatArray]:
    """Positions, velocities and accelerations (T, joints): sums of five sines of 0.1 to 0.9 Hz."""
    w = 2.0 * np.pi * np.array([0.1, 0.25, 0.4, 0.6, 0.9])[:, None, None]
    phase, size = (
        rng.uniform(0.0, 2.0 * np.pi, (5, 1, joints)),
        rng.uniform(0.3, 1.0, (5, 1, joints)) / (w / w[0]) ** 0.8,
    )
    return [
        (0.7 * size * w**k * np.sin(w * t[:, None] + phase + k * np.pi / 2)).sum(axis=0) for k in range(3)
    ]


def recorded(system: System, theta: FloatArray, noise: float, seed: int) -> tuple[Log, list[FloatArray]]:
    """A log of the true model, and the motion."""
    rng, t = np.random.default_rng([seed, 2]), np.arange(0.0, SECONDS, DT)
    moved = motion(np.random.default_rng([seed, 1]), t)
    tau = torques(system, theta, moved)
    arrays = {
        "joints": {"time": t, "position": moved[0] + noise * rng.standard_normal(tau.shape)},
        "torque": {"time": t, "effort": tau + TORQUE * rng.standard_normal(tau.shape)},
    }
    return Log.from_arrays(arrays, system), moved


def torques(system: System, theta: FloatArray, moved: list[FloatArray]) -> FloatArray:
    """Torques that a motion needs, shape (T, 7)."""
    model = system.edits.apply(system.model, theta)
    return forces_along(model, moved[0], moved[1], moved[2]).needed + model.dof_frictionloss * np.sign(
        moved[1]
    )


def bound(system: System, z: FloatArray, moved: list[FloatArray]) -> FloatArray:
    """Least sd of z, the prior's share included, shape (d,), from all torques."""
    states, step = [one[::EVERY] for one in moved], 1e-3
    slopes = [
        (torques(system, system.space.theta_of(z + row), states)
         - torques(system, system.space.theta_of(z - row), states)) / (2.0 * step * TORQUE)
        for row in step * np.eye(z.size)
    ]  # fmt: skip
    flat = np.reshape(slopes, (z.size, -1))
    return np.sqrt(np.diag(np.linalg.inv(EVERY * flat @ flat.T + np.eye(z.size))))


def columns(model: mujoco.MjModel, moved: Sequence[FloatArray], dry: FloatArray) -> FloatArray:
    """All slopes of the torques, by inertias and both frictions of every joint, shape (T, 7, 84)."""
    slopes = body_slopes(model, range(1, 8), *moved)
    own = (one[:, :, None] * np.eye(7) for one in (moved[1], dry))
    return np.concatenate((slopes, *own), axis=2)


def plain(system: System, log: Log, fresh: FloatArray) -> tuple[float, FloatArray]:
    """Plain least squares: CPU time, and torques (T, 7) that it predicts for a motion with these slopes."""
    begun = time.process_time()
    cost = MatchingCost(system, [whole(log)], open_engine(system), system.settings.cost)
    along = cost.clips.starts.along
    assert along is not None
    slopes = columns(system.model, along.flat, along.dry[0])
    known = system.model.dof_armature * along.qacc[0]
    of = [(o.mask[0], o.measured[0, :, 0] - known[:, j]) for j, o in enumerate(cost.clips.observed)]
    regressor = np.concatenate([slopes[mask, j] for j, (mask, _) in enumerate(of)])
    found = np.linalg.lstsq(regressor, np.concatenate([left[mask] for mask, left in of]), rcond=1e-8)[0]
    return time.process_time() - begun, fresh @ found


def pull(predicted: FloatArray, true: FloatArray) -> float:
    """By how much predictions are too small, as a share."""
    return float(1.0 - (predicted * true).sum() / (true**2).sum())


def trial(seed: int, noise: float) -> dict[str, Any]:
    """Identify one log."""
    logging.disable(logging.WARNING)
    system = system_of(noise)
    z = np.clip(np.random.default_rng([seed, 3]).standard_normal(len(system.space)), -2.0, 2.0)
    z = system.space.clip(z)
    truth = system.space.theta_of(z)
    log, moved = recorded(system, truth, noise, seed)
    begun = time.process_time()
    result = identify(system, log, threads=1)
    spent = time.process_time() - begun
    parameters = list(result.parameters.values())
    found = np.array([p.estimate for p in parameters])
    new = motion(np.random.default_rng([seed, 4]), np.arange(0.0, 10.0, 0.01))
    fresh, true = columns(system.model, new, np.sign(new[1])), torques(system, truth, new)
    _clear()
    seconds, predicted = plain(system, log, fresh)
    predicted = predicted + system.model.dof_armature * new[2]
    return {
        "over": ((system.space.z_of(found) - z) / bound(system, z, moved)).tolist(),
        "inside": [bool(p.interval[0] <= t <= p.interval[1]) for p, t in zip(parameters, truth, strict=True)],
        "spent": spent,
        "plain": seconds,
        "pull": [pull(torques(system, found, new), true), pull(predicted, true)],
        "rms": [
            float(np.sqrt(((one - true) ** 2).mean())) for one in (torques(system, found, new), predicted)
        ],
    }


def held_out(system: System, log: Log, model: mujoco.MjModel) -> FloatArray:
    """Rms error of each torque on the last fifth of a log: as given, by least squares, by amhe, (3, nv)."""
    split = int(0.8 * log.steps)
    result = identify(system, Window(log, 0, split).alone(0).log, threads=1)
    values = {name: p.estimate for name, p in result.parameters.items()}
    theta = np.array([values[name] for name in system.space.names])
    cost = MatchingCost(system, [whole(log)], open_engine(system), system.settings.cost)
    along, predicted = cost.clips.starts.along, cost.predict(system.space.z_of(theta)[None]).values
    assert along is not None
    q, v, a = along.flat
    given = forces_along(model, q, v, a).needed + model.dof_frictionloss * along.dry[0]
    slopes = body_slopes(model, range(1, model.nbody), q, v, a)
    found, joints = np.empty((3, len(predicted))), []
    for j, (one, fitted) in enumerate(zip(cost.clips.observed, predicted, strict=True)):
        mask, tau = one.mask[0], one.measured[0, :, 0]
        (dof,) = one.channel.columns
        own = np.stack((v[:, dof], along.dry[0, :, dof], np.ones_like(tau)), axis=1)
        columns = np.zeros((len(tau), slopes.shape[2] + 3 * len(predicted)))
        columns[:, : slopes.shape[2]] = slopes[:, dof]
        columns[:, slopes.shape[2] + 3 * j : slopes.shape[2] + 3 * j + 3] = own
        first = one.rows[0] < split
        parts = (columns, tau - model.dof_armature[dof] * a[:, dof], mask & first)
        joints.append(parts)
        found[0, j] = _rms((given[:, dof] - tau)[mask & ~first])
        found[2, j] = _rms((fitted[0, 0, :, 0] - tau)[mask & ~first])
    regressor, target = (np.concatenate([p[k][p[2]] for p in joints]) for k in range(2))
    solution = np.linalg.lstsq(regressor, target, rcond=1e-8)[0]
    for j, (columns, target, _) in enumerate(joints):
        one = cost.clips.observed[j]
        last = one.mask[0] & (one.rows[0] >= split)
        found[1, j] = _rms((columns @ solution - target)[last])
    return found


def _rms(error: FloatArray) -> float:
    return float(np.sqrt((error**2).mean()))


def compare_held_out() -> None:
    """The tables of --held-out."""
    logging.disable(logging.WARNING)
    with tempfile.TemporaryDirectory() as folder:
        logs_of = PROJECT / "examples" / "logs"
        csv, mjcf = logs_of / "arm_torque.csv", logs_of / "arm_torque.xml"
        init_system(mjcf, [csv], Path(folder))
        system = System.load(folder, warn=False)
        given = mujoco.MjModel.from_xml_path(str(mjcf))
        logs = {"example:arm_torque": (system, amhe.read_log(csv, system), given)}
        drawn = system_of(1e-4)
        z = np.clip(np.random.default_rng([0, 3]).standard_normal(len(drawn.space)), -2.0, 2.0)
        truth = drawn.space.theta_of(drawn.space.clip(z))
        logs["the arm above"] = drawn, recorded(drawn, truth, 1e-4, 0)[0], drawn.model
        for name, given in logs.items():
            found = held_out(*given)
            rows = [
                (label, *(f"{value:.3f}" for value in row), f"{_rms(row):.3f}")
                for label, row in zip(("as given", "plain least squares", "amhe"), found, strict=True)
            ]
            heads = ("", *(f"j{i + 1}" for i in range(found.shape[1])), "all")
            show(f"{name}: torque on the fifth that was not fitted, rms [N m]", heads, rows)


def _clear() -> None:
    """Forget motions that were smoothed: plain least squares begins where identification began."""
    for kept in (efforts._path, efforts._filtered, measured._motion):  # pyright: ignore[reportPrivateUsage]
        kept.cache_clear()


def main() -> None:
    parser = argparse.ArgumentParser(description="Matching efforts on simulated logs.")
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--quick", action="store_true", help="4 seeds")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--held-out", action="store_true", help="torques of what was not fitted, by joint")
    options = parser.parse_args()
    if options.held_out:
        compare_held_out()
        return
    seeds, rows = 4 if options.quick else options.seeds, []
    for noise in (1e-4, 1e-3):
        one = functools.partial(trial, noise=noise)
        some = over_seeds(f"effort-{noise:g}", one, range(seeds), options.processes)
        over, inside = (np.array([each[key] for each in some], dtype=float) for key in ("over", "inside"))
        spent, plainly, pulls, rms = (
            np.mean([each[key] for each in some], axis=0) for key in ("spent", "plain", "pull", "rms")
        )
        rows += [
            (f"noise of positions [mrad]: {1e3 * noise:g}", "", "", ""),
            ("error over the Cramer-Rao bound", f"{np.sqrt((over**2).mean()):.2f}", "", "at most 1.2"),
            ("90 % intervals hold", f"{inside.mean():.1%}", "", "86 to 94 %"),
            ("CPU time [s]", f"{spent:.2f}", f"{plainly:.2f}", "at most 5, and twice plain"),
            (
                "torques of a fresh motion too small by",
                f"{pulls[0]:.2%}",
                f"{pulls[1]:.2%}",
                "less than plain",
            ),
            ("their error, rms [N m]", f"{rms[0]:.4f}", f"{rms[1]:.4f}", ""),
        ]
    show(
        f"Efforts of 7 joints, 60 unknowns, {seeds} logs of {SECONDS:g} s at {1 / DT:g} Hz",
        ("", "amhe", "plain least squares", "goal"),
        rows,
    )


if __name__ == "__main__":
    main()
