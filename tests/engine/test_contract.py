"""What every engine must do: alignment, independence, delays, divergence, predictions."""

from __future__ import annotations

import copy
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import mujoco
import numpy as np
import pytest

from amhe_cli.core.arrays import to_host
from amhe_cli.core.parameters import Parameter
from amhe_cli.engine import cpu
from amhe_cli.engine.open import open_engine
from amhe_cli.engine.rollout import Engine, Starts, Wanted
from amhe_cli.system.parameters.edits import Cells
from amhe_cli.system.system import System
from tests.conftest import MODELS
from tests.engine.conftest import ENGINES, Open

PENDULUM = System.load("pendulum")
CUBE = System.load("cube_toss")
#: Two carts of 1 kg without friction; a command delay shifts the push of the first only.
CARTS = """
<mujoco><option timestep="0.01" gravity="0 0 0"/>
  <worldbody>
    <body name="one"><joint name="x" type="slide" axis="1 0 0"/><geom size=".1" mass="1"/></body>
    <body name="two" pos="0 1 0"><joint name="y" type="slide" axis="1 0 0"/><geom size=".1" mass="1"/></body>
  </worldbody>
  <actuator><motor name="push" joint="x"/><motor name="pull" joint="y"/></actuator></mujoco>
"""
DELAYED = """
model: carts.xml
parameters:
  delay: {nominal: 0.01, bounds: [0.001, 0.05], targets: [{actuator: push, set: command_delay}]}
signals:
  state: {topic: /joint_states, joints: [x, y], noise: {position: 0.001}}
  force: {topic: /force, actuators: [push, pull], quantity: effort}
"""

Call = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def rounding(engine: Engine, steps: float = 1.0) -> float:
    """What rounding may do to numbers of size 1 within so many steps that amplify it."""
    return max(1e-12, 10.0 * engine.precision) * steps


def some(count: int = 20, seed: int = 0) -> Call:
    """Rollouts of the pendulum, of different lengths."""
    rng = np.random.default_rng(seed)
    theta = PENDULUM.space.theta_of(rng.normal(0.0, 0.5, (count, 4)))
    qpos, qvel = rng.normal(0.0, 0.3, (count, 1)), rng.normal(0.0, 1.0, (count, 1))
    return theta, qpos, qvel, rng.normal(size=(count, 40, 1)), rng.integers(5, 41, count)


def clips(system: System, count: int = 3, horizon: int = 30, seed: int = 1) -> tuple[Starts, list[Wanted]]:
    """Clips of different lengths, and rows of all their states that are wanted."""
    model, rng = system.model, np.random.default_rng(seed)
    lengths = rng.integers(horizon // 2, horizon + 1, count)
    lengths[0] = horizon
    qpos = np.tile(model.qpos0, (count, 1))
    starts = Starts(
        qpos=qpos,
        qvel=rng.normal(size=(count, model.nv)),
        inputs=rng.normal(size=(count, horizon, model.nu)),
        history=0,
        lengths=lengths,
        first_index=np.arange(0, 2 * model.nv, 2),
        first_sd=rng.uniform(0.05, 0.15, (count, model.nv)),
    )
    rows = rng.integers(0, lengths[:, None], (count, 7))
    return starts, [Wanted("qpos", rows, tuple(range(model.nq))), Wanted("qvel", rows, (model.nv - 1,))]


def test_row_k_is_the_state_after_input_k(opened: Open) -> None:
    theta, qpos, qvel, inputs, lengths = some(4)
    engine = opened(PENDULUM)
    done = engine.rollout(theta, qpos, qvel, inputs, lengths)
    for i, length in enumerate(lengths):
        model = PENDULUM.edits.apply(PENDULUM.model, theta[i])
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = qpos[i], qvel[i]
        for k in range(length):
            data.ctrl[:] = inputs[i, k]
            mujoco.mj_step(model, data)
            assert done.qpos[i, k] == pytest.approx(data.qpos, abs=rounding(engine))
            assert done.qvel[i, k] == pytest.approx(data.qvel, abs=rounding(engine))


def test_sensors_describe_the_same_instant_as_the_state(opened: Open) -> None:
    spec = mujoco.MjSpec.from_file(str(MODELS / "pendulum" / "scene.xml"))
    spec.add_sensor(
        name="q", type=mujoco.mjtSensor.mjSENS_JOINTPOS, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname="hinge"
    )
    engine = opened(PENDULUM, sensors=True, model=spec.compile())
    call = some()
    done = engine.rollout(*call)
    assert done.sensordata is not None
    for i, length in enumerate(call[-1]):
        np.testing.assert_array_equal(done.sensordata[i, :length], done.qpos[i, :length])


def test_rollouts_do_not_depend_on_their_company(opened: Open) -> None:
    """Nor on the lengths of the others, nor on calls before."""
    call = some()
    engine = opened(PENDULUM)
    together = engine.rollout(*call)
    engine.rollout(*some(5, seed=3))
    for i in (0, 11, 11):  # the second time in the simulation that has these parameters already
        alone = engine.rollout(*(part[i : i + 1] for part in call))
        length = call[-1][i]
        np.testing.assert_array_equal(together.qpos[i, :length], alone.qpos[0, :length])
        np.testing.assert_array_equal(together.qvel[i, :length], alone.qvel[0, :length])


@pytest.mark.parametrize("reset", [True, False], ids=["reset", "no reset"])
def test_a_diverged_rollout_is_marked_and_finite(opened: Open, reset: bool) -> None:
    """A model may switch off MuJoCo's reset of bad states, which then stay in the records."""
    model = copy.copy(PENDULUM.model)
    if not reset:
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    theta, qpos, qvel, inputs, _ = some()
    qvel[[1, 5, 9]] = speeds = np.array([[1e12], [1e300], [np.nan]])
    engine = opened(PENDULUM, model=model)
    done = engine.rollout(theta, qpos, qvel, inputs, np.full(20, 40))
    assert (~done.completed).nonzero()[0].tolist() == [1, 5, 9]
    assert np.isfinite(done.qpos).all()
    assert np.isfinite(done.qvel).all()
    qvel[[1, 5, 9]] = 0.0
    again, fresh = (e.rollout(theta, qpos, qvel, inputs, np.full(20, 40)) for e in (engine, opened(PENDULUM)))
    assert again.completed.all(), "nothing is left of it"
    np.testing.assert_array_equal(again.qpos, fresh.qpos)
    starts, wanted = clips(PENDULUM, 5)
    starts.qvel[2:] = speeds
    predicted = engine.predict(theta[:3], starts, None, wanted)
    assert predicted.completed.tolist() == 3 * [[True, True, False, False, False]]
    assert all(np.isfinite(to_host(values)).all() for values in predicted.values)


def test_parameters_reach_the_model_with_all_that_follows_from_them(opened: Open) -> None:
    """A cube that slides at v stops after v^2 / (2 mu g), whatever its mass."""
    speed, steps = 0.5, 350
    mu = np.array([0.2, 0.4, 0.4])
    theta = np.tile(CUBE.space.nominal, (3, 1))
    theta[:, CUBE.space.names.index("friction")] = mu
    theta[2, CUBE.space.names.index("mass")] *= 2.0
    rest = np.array([0.0, 0.0, 0.0523, 1.0, 0.0, 0.0, 0.0])
    sliding = np.tile(rest, (3, 1)), np.tile([speed, 0, 0, 0, 0, 0], (3, 1))
    engine = opened(CUBE)
    done = engine.rollout(theta, *sliding, np.zeros((3, steps, 0)), np.full(3, steps))
    way = done.qpos[:, -1, 0]
    assert way == pytest.approx(speed**2 / (2.0 * mu * 9.81), rel=0.03)
    assert way[1] == pytest.approx(way[2], rel=1e-6 if engine.precision < 1e-12 else 0.02)


def test_predictions_are_picked_from_the_rollouts_of_every_candidate_on_every_clip(opened: Open) -> None:
    """With the errors of their first states, which are MuJoCo's own steps in the tangent space."""
    starts, wanted = clips(CUBE)
    rng, (c, nv) = np.random.default_rng(4), starts.qvel.shape
    theta = CUBE.space.theta_of(rng.normal(0.0, 0.3, (5, 4)))
    errors = rng.normal(size=(5, c, starts.first_index.size))
    engine = opened(CUBE)
    plain, moved = engine.predict(theta, starts, None, wanted), engine.predict(theta, starts, errors, wanted)
    assert [values.shape for values in moved.values] == [(5, c, 7, 7), (5, c, 7, 1)]
    assert moved.completed.shape == (5, c)
    pairs = [(i, j) for i in range(5) for j in range(c)]
    candidates, of_clips = map(list, zip(*pairs, strict=True))
    for predicted, scale in ((plain, 0.0), (moved, 1.0)):
        tangent = np.zeros((len(pairs), 2 * nv))
        tangent[:, starts.first_index] = scale * errors[candidates, of_clips] * starts.first_sd[of_clips]
        qpos = starts.qpos[of_clips]
        for row, step in zip(qpos, tangent, strict=True):
            mujoco.mj_integratePos(CUBE.model, row, step[:nv], 1.0)
        qvel, inputs = starts.qvel[of_clips] + tangent[:, nv:], starts.inputs[of_clips]
        alone = engine.rollout(theta[candidates], qpos, qvel, inputs, starts.lengths[of_clips])
        for values, want in zip(predicted.values, wanted, strict=True):
            for (i, j), states in zip(pairs, getattr(alone, want.source), strict=True):
                expected = states[want.rows[j]][:, list(want.columns)]
                np.testing.assert_allclose(to_host(values)[i, j], expected, atol=rounding(engine, 1e3))


@pytest.mark.parametrize("limit", [1, 30_000], ids=["one rollout", "some rollouts"])
@pytest.mark.parametrize("count", [1, 5])
@pytest.mark.parametrize("name", [name for name in ENGINES if name != "warp"])
def test_a_prediction_that_is_cut_to_save_memory_is_the_same_to_the_bit(
    name: str, count: int, limit: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By clips too, where the rollouts of one candidate need more memory than there is for all."""
    starts, wanted = clips(CUBE, 20)
    rng = np.random.default_rng(4)
    theta = CUBE.space.theta_of(rng.normal(0.0, 0.3, (count, 4)))
    errors = rng.normal(size=(count, 20, starts.first_index.size))
    whole = open_engine(CUBE).predict(theta, starts, errors, wanted)
    monkeypatch.setattr(cpu, "RECORD_BYTES", limit)
    given = dict(ENGINES[name])
    with ThreadPoolExecutor(1) as worker:  # where the limit is the same, unlike in another process
        engine = open_engine(CUBE, executor=worker if given.pop("spread", False) else None, **given)
        parts = engine.predict(theta, starts, errors, wanted)
    np.testing.assert_array_equal(parts.completed, whole.completed)
    for one, other in zip(parts.values, whole.values, strict=True):
        np.testing.assert_array_equal(one, other)
        assert one.sum() == other.sum(), "they lie in the same order in memory"


def test_a_fraction_of_a_step_of_command_delay_is_interpolated(opened: Open, tmp_path: Path) -> None:
    """Under a ramp of force a k on a cart of mass 1, delayed by s steps: v_n = dt sum of a (k - s)."""
    (tmp_path / "carts.xml").write_text(CARTS)
    (tmp_path / "system.yaml").write_text(DELAYED)
    system, dt = System.load(tmp_path), 0.01
    history, horizon, slope, delays = 6, 20, 0.3, np.array([0.0, 1.0, 1.5, 3.75])
    ramp = slope * np.arange(-history, horizon, dtype=np.float64)
    starts = Starts(
        qpos=np.zeros((1, 2)),
        qvel=np.zeros((1, 2)),
        inputs=np.repeat(ramp[None, :, None], 2, axis=2),
        history=history,
        lengths=np.array([horizon]),
        first_index=np.zeros(0, dtype=np.int64),
        first_sd=np.zeros((1, 0)),
    )
    wanted = [Wanted("qvel", np.arange(horizon)[None], (0, 1))]
    engine = opened(system)
    (found,) = engine.predict(dt * delays[:, None], starts, None, wanted).values
    values = to_host(found)
    steps = np.arange(horizon)
    for i, delay in enumerate(delays):
        late, prompt = (dt * slope * np.cumsum(steps - shift) for shift in (delay, 0.0))
        expected = np.stack((late, prompt), axis=1)
        np.testing.assert_allclose(values[i, 0], expected, atol=rounding(engine))


def test_the_same_engine_upon_another_model(opened: Open) -> None:
    heavy = copy.copy(PENDULUM.model)
    heavy.opt.gravity[2] *= 3.0
    call = some()
    moved, expected = opened(PENDULUM).upon(heavy), opened(PENDULUM, model=heavy)
    assert type(moved) is type(expected)
    found = moved.rollout(*call).qpos
    np.testing.assert_array_equal(found[:, :5], expected.rollout(*call).qpos[:, :5])
    assert (found[:, 4] != opened(PENDULUM).rollout(*call).qpos[:, 4]).any()


def test_the_same_engine_with_further_parameters(opened: Open) -> None:
    limit = Parameter("limit", "-", 1.0, 0.01, 10.0, log=True, prior_sd=0.2)
    ends = (Cells("actuator_forcerange", 0, (1,)), Cells("actuator_forcerange", 0, (0,), -1.0))
    wider = PENDULUM.edits.extended(PENDULUM.model, [(limit, ends, "scale")], PENDULUM.calibration)
    theta, *rest = some()
    engine, plain = opened(PENDULUM).upon(PENDULUM.model, wider), opened(PENDULUM).rollout(theta, *rest)
    weak, same = (
        engine.rollout(np.column_stack((theta, np.full(len(theta), value))), *rest) for value in (0.01, 1.0)
    )
    np.testing.assert_array_equal(same.qpos[:, :5], plain.qpos[:, :5])
    assert (weak.qpos[:, 4] != plain.qpos[:, 4]).any()
