"""An estimate does not depend on whether an engine computes with seven digits or with sixteen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.core.log import Log
from amhe_cli.engine.open import open_engine
from amhe_cli.engine.rollout import Engine, Predicted, Rollouts
from amhe_cli.estimation.offline import search
from amhe_cli.estimation.offline.clips import ClipPool, whole
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.estimation.uncertainty.assumed import assumed
from amhe_cli.estimation.uncertainty.fit import FinalFit, final_fit
from amhe_cli.system.system import System
from tests.matching.test_cost import toss

LOGS = Path(__file__).parents[2] / "examples" / "logs"
STEP, SECONDS = 0.005, 1.0
#: What is fitted of a longer log, from its middle [s].
PART = 1.2
AXES = ([1, 0, 0], [0, 1, 0], [0, 0, 1])


class Single:
    """An engine that rounds parameters, states and what it predicts to float32, as that of the cards does."""

    precision, device_bytes = float(np.finfo(np.float32).eps), 0

    def __init__(self, engine: Engine) -> None:
        self.engine = engine

    def rollout(self, theta: Any, qpos: Any, qvel: Any, inputs: Any, lengths: Any) -> Rollouts:
        return self.engine.rollout(rounded(theta), rounded(qpos), rounded(qvel), rounded(inputs), lengths)

    def predict(self, theta: Any, starts: Any, errors: Any, wanted: Any) -> Predicted:
        starts = replace(starts, **{n: rounded(getattr(starts, n)) for n in ("qpos", "qvel", "inputs")})
        done = self.engine.predict(rounded(theta), starts, errors, wanted)
        return Predicted(tuple(map(rounded, done.values)), done.completed)

    def upon(self, model: Any, edits: Any = None) -> Engine:
        return Single(self.engine.upon(model, edits))


def rounded(values: np.ndarray) -> np.ndarray:
    return values.astype(np.float32).astype(np.float64)


def fitted(system: System, logs: Sequence[Log], engine: Engine, seed: int = 0) -> FinalFit:
    parts = []
    for part in map(whole, logs):
        first = part.start + int(0.4 * part.length) * (part.duration > PART)
        length = min(part.start + part.length - first, round(PART / system.dt))
        parts.append(replace(part, start=first, length=length))
    problem = Problem(system, ClipPool(system, parts, system.settings.clips), engine, seed)
    state = search.start(problem)
    while not state.done:
        state = search.advance(problem, state)
    return final_fit(problem, state)


def apart(system: System, *logs: Log, alike: float = 0.3) -> float:
    """How far apart the estimates of both engines are, in posterior sds, which are alike within a share.

    So are the sds with what assumed values leave open, by which verdicts are given.
    """
    one, other = (fitted(system, logs, engine(open_engine(system))) for engine in (lambda e: e, Single))
    assert (one.posterior.sd < 0.9).any(), "the log knows something"
    open_too = [
        np.sqrt((fit.posterior.covariance + assumed(fit)[0].covariance).diagonal()) for fit in (one, other)
    ]
    for sds in ((one.posterior.sd, other.posterior.sd), open_too):
        np.testing.assert_allclose(np.log(sds[1] / sds[0]), 0.0, atol=np.log1p(alike))
    return float(np.abs((other.z - one.z) / one.posterior.sd).max())


def chain(rng: np.random.Generator) -> tuple[System, Log]:
    """Up to three links in the air, some of them driven, of which up to six numbers are unknown."""
    spec, parent = mujoco.MjSpec(), None
    spec.option.timestep = STEP
    joints, driven, targets = [f"j{i}" for i in range(rng.integers(1, 4))], [], {}
    for name in joints:
        parent = (parent or spec.worldbody).add_body(name=name, pos=[0, 0, -0.3 if parent else 1.0])
        slide = rng.random() < 0.2
        kind = mujoco.mjtJoint.mjJNT_SLIDE if slide else mujoco.mjtJoint.mjJNT_HINGE
        parent.add_joint(
            name=name, type=kind, axis=AXES[rng.integers(3)], damping=10.0 ** rng.uniform(-2, 0),
            armature=10.0 ** rng.uniform(-3, -1), frictionloss=rng.choice([0.0, 0.05]),
            stiffness=30.0 * slide,
        )  # fmt: skip
        parent.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[0, 0, 0, 0.05, 0, -0.3], size=[0.02, 0, 0],
            mass=10.0 ** rng.uniform(-1, 0.5), contype=0, conaffinity=0,
        )  # fmt: skip
        targets[f"damping_{name}"] = {"joint": name, "set": "damping"}
        targets[f"armature_{name}"] = {"joint": name, "set": "armature"}
        if name == joints[0] or rng.random() < 0.5:
            driven.append(name)
            motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            motor.set_to_position(kp=10.0 ** rng.uniform(0.5, 1.5), kv=0.5)
    system = System.from_model(
        spec,
        parameters={name: {"targets": [target]} for name, target in targets.items()},
        signals={
            "joints": {"joints": joints, "noise": {"position": 1e-3}},
            "command": {"actuators": driven, "quantity": "position"},
        },
        settings={"clips": {"length": [0.2, 0.3], "count": 4}, "identify": {"samples": 8}},
        name="chain", warn=False,
    )  # fmt: skip
    time = STEP * np.arange(round(SECONDS / STEP))
    command = np.sin(2 * np.pi * rng.uniform(0.5, 3.0, len(driven)) * time[:, None])
    theta = system.space.theta_of(0.3 * rng.standard_normal(len(system.space)))
    data = mujoco.MjData(plant := system.edits.apply(system.model, theta))
    position = np.empty((len(time), len(joints)))
    for k in range(len(time)):
        position[k], data.ctrl[:] = data.qpos, command[k]
        mujoco.mj_step(plant, data)
    position += 1e-3 * rng.standard_normal(position.shape)
    arrays = {"joints": {"time": time, "position": position}, "command": {"time": time, "position": command}}
    return system, Log.from_arrays(arrays, system)


@pytest.mark.slow
@pytest.mark.parametrize("first", range(0, 200, 50))
def test_random_models(first: int) -> None:
    """Each search ends; of every fifth, its estimate is compared."""
    for seed in range(first, first + 50):
        system, log = chain(np.random.default_rng(seed))
        if seed % 5:
            assert np.isfinite(fitted(system, [log], Single(open_engine(system))).posterior.sd).all(), seed
        else:
            assert apart(system, log) < 0.2, seed


@pytest.mark.slow
@pytest.mark.parametrize("model", [29, 46])
def test_random_models_on_which_searches_of_other_seeds_differ(model: int) -> None:
    """With sixteen digits, too, by more than 0.2 sd: the middle of several is what precision may not move."""
    system, log = chain(np.random.default_rng(model))
    middles, sds = [], []
    for engine in (open_engine(system), Single(open_engine(system))):
        fits = [fitted(system, [log], engine, seed) for seed in range(3)]
        middles.append(np.median([fit.z for fit in fits], axis=0))
        sds.append(np.median([fit.posterior.sd for fit in fits], axis=0))
    assert (np.abs(middles[1] - middles[0]) < 0.2 * sds[0]).all()
    np.testing.assert_allclose(np.log(sds[1] / sds[0]), 0.0, atol=np.log(1.3))


def bundled(name: str) -> System:
    dear = {"iterations": 4, "polish": 1} if name == "go1_push" else {"iterations": 8}
    few = 4 if name in ("pendulum", "cube_toss") else 2  # what is pushed costs ten times as much
    short = {"clips": {"length": [0.2, 0.3], "count": few, "held_out": 0.0}}
    return System.load(name, short | {"identify": {"samples": 16, **dear}})


def noisy(log: Log, rng: np.random.Generator) -> Log:
    """A log whose sensors err by more than single precision does."""
    sds = {"cube.position": 1e-3, "cube.orientation": 3e-3, "cube.linear_velocity": 0.02}
    noise = {key: sd * rng.standard_normal(log[key].values.shape) for key, sd in sds.items()}
    more = {key: replace(log[key], values=log[key].values + error) for key, error in noise.items()}
    return replace(log, series=dict(log.series) | more)


LOG_OF = {"pendulum": "pendulum", "pusher": "pusher", "pushed_box": "pusher", "go1_push": "t1"}


@pytest.mark.slow
@pytest.mark.parametrize("name", [*LOG_OF, "cube_toss"])
def test_bundled_systems(name: str) -> None:
    """Behind contacts rounding changes what follows: estimates and sds are less alike there."""
    system, smooth = bundled(name), name == "pendulum"
    if name == "cube_toss":
        logs = [noisy(toss(seed=seed), np.random.default_rng(seed)) for seed in range(8)]
    else:
        logs = [amhe.read_log(LOGS / f"{LOG_OF[name]}.mcap", system)]
    assert apart(system, *logs, alike=0.3 if smooth else 2.0) < (1.0 if smooth else 2.0)
