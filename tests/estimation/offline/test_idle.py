"""Why logs do not depend on a parameter: nothing touches, or no measurement sees it."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest

from amhe_cli.core.each_log import searched
from amhe_cli.core.log import Log
from amhe_cli.engine.open import open_engine
from amhe_cli.engine.rollout import Engine, Predicted, Rollouts
from amhe_cli.estimation.offline.clips import ClipPool, whole
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.system.parameters.contacts import needed_contacts
from amhe_cli.system.system import System
from tests.estimation.conftest import CHEAP
from tests.estimation.test_identification import fall

XML = """
<mujoco>
  <option timestep="0.005" cone="elliptic"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1"/>
    <body name="pusher" mocap="true" pos="-0.5 0 0.1"><geom name="tip" type="sphere" size="0.05"/></body>
    <body name="block" pos="0 0 0.1">
      <freejoint/>
      <geom name="block" type="box" size="0.1 0.1 0.1" mass="1"/>
    </body>
  </worldbody>
  <contact>
    <pair name="slide" geom1="floor" geom2="block"/>
    <pair name="push" geom1="tip" geom2="block"/>
  </contact>
</mujoco>
"""


def system() -> System:
    return System.from_model(
        mujoco.MjSpec.from_string(XML.replace('size="0.05"/>', 'size="0.05" contype="0" conaffinity="0"/>')),
        name="push",
        parameters={
            "mass": {"targets": [{"body": "block", "set": "mass"}]},
            "tip_friction": {"targets": [{"pair": "push", "set": "sliding_friction"}]},
        },
        signals={
            "block": {"body": "block", "noise": {"position": 0.001, "orientation": 0.01}},
            "pusher": {"mocap": "pusher"},
        },
        settings={"clips": {"count": 4, "length": [0.3, 0.4], "still": 0.0}},
        warn=False,
    )


def problem(made: System, offset: float) -> Problem:
    """A pusher that moves to and fro, its pose measured with an offset; the block slides before it."""
    times = np.arange(0.0, 2.0, 0.01)
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))
    x, zero = 0.3 * times, 0.0 * times
    block = np.stack([x, zero, zero + 0.1], axis=1)
    tip = np.stack([x - 0.145 - offset, zero, zero + 0.1], axis=1)
    arrays = {
        "block": {"time": times, "position": block, "orientation": upright},
        "pusher": {"time": times, "position": tip, "orientation": upright},
    }
    log = Log.from_arrays(arrays, made)
    return Problem(made, ClipPool(made, [whole(log)], made.settings.clips), open_engine(made), 0)


def test_a_pusher_whose_frame_is_wrong_touches_nothing_and_the_reason_gives_the_gap() -> None:
    found = problem(system(), 0.4)
    assert found.idle.keys() == {"mass", "tip_friction"}
    for reason in found.idle.values():
        gap = re.match(r"nothing touches: geom '\w+' and geom '\w+' come no nearer than (\S+) m in", reason)
        assert gap is not None and 0.25 < float(gap[1]) < 0.4  # the block slows down, the pusher does not
        assert "frames" in reason


def test_where_they_touch_a_mass_before_a_kinematic_pusher_is_idle_for_another_reason() -> None:
    found = problem(system(), 0.0)
    assert found.idle.get("mass") == "no measurement in these logs depends on it"
    assert not any("nothing touches" in reason for reason in found.idle.values())


@pytest.mark.parametrize(
    ("target", "pairs"),
    [
        ({"body": "block", "set": "mass"}, {("block", "tip")}),
        ({"pair": "slide", "set": "sliding_friction"}, {("floor", "block")}),
    ],
)
def test_the_contacts_that_a_parameter_needs(target: dict, pairs: set) -> None:
    made = System.from_model(
        mujoco.MjSpec.from_string(XML),
        parameters={"one": {"targets": [target]}},
        signals={"block": {"body": "block", "noise": {"position": 0.001}}},
        warn=False,
    )
    ((_, cells),) = made.edits.by_parameter()
    found = {tuple(made.model.geom(g).name for g in pair) for pair in needed_contacts(made.model, cells)}
    assert found == pairs


def test_a_nominal_value_that_is_far_too_small_is_the_reason() -> None:
    # mujoco#3284: a search that starts at 1e-8 stays there
    tiny = {"nominal": 2e-8, "bounds": [1e-8, 10.0], "targets": [{"joint": "hinge", "set": "damping"}]}
    made = System.from_model(
        mujoco.MjSpec.from_string(
            '<mujoco><worldbody><body><joint name="hinge" axis="0 1 0"/><geom type="capsule" '
            'fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.4"/></body></worldbody></mujoco>'
        ),
        parameters={"damping": tiny},
        signals={"joints": {"joints": ["hinge"], "noise": {"position": 0.001}}},
        settings={"clips": {"length": [0.3, 0.4]}},
        warn=False,
    )
    times = np.arange(0.0, 2.0, 0.01)
    arrays = {"joints": {"time": times, "position": np.cos(6.0 * times)[:, None]}}
    log = Log.from_arrays(arrays, made)
    found = Problem(made, ClipPool(made, [whole(log)], made.settings.clips), open_engine(made), 0)
    assert "give a nominal value of the right size" in found.idle["damping"]


class Coarse:
    """An engine whose rounding contacts have amplified, as on a graphics card."""

    precision = float(np.finfo(np.float32).eps)

    def __init__(self, engine: Engine) -> None:
        self.engine, self.rng = engine, np.random.default_rng(0)

    def rollout(self, theta: Any, qpos: Any, qvel: Any, inputs: Any, lengths: Any) -> Rollouts:
        return self.engine.rollout(theta, qpos, qvel, inputs, lengths)

    def predict(self, theta: Any, starts: Any, errors: Any, wanted: Any) -> Predicted:
        done = self.engine.predict(theta, starts, errors, wanted)
        return Predicted(tuple(v + 0.01 * self.rng.normal(size=v.shape) for v in done.values), done.completed)

    def upon(self, model: Any, edits: Any = None) -> Engine:
        return Coarse(self.engine.upon(model, edits))


def test_rounding_behind_contacts_is_no_effect_of_a_parameter() -> None:
    """The motion of a tossed cube does not depend on its mass."""
    cube = System.load("cube_toss", {**CHEAP, "clips": {"count": 4, "length": [0.1, 0.2]}})
    pool = ClipPool(cube, [whole(fall(cube))], cube.settings.clips)
    active = Problem(cube, pool, Coarse(open_engine(cube)), 0).active
    assert dict(zip(cube.space.names, active, strict=True)) == {
        "friction": True, "inertia_scale": True, "contact_damping": True, "mass": False,
    }  # fmt: skip


def test_of_many_logs_each_value_of_its_own_is_seen(pendulum: System, swing) -> None:
    """Clips that show what moves what are few, and some of each log with a value of its own."""
    logs = [swing(1.5, seed=i).with_(own={"friction_loss": f"servo {i}"}) for i in range(20)]
    system = replace(pendulum, space=searched(pendulum.space, logs))
    pool = ClipPool(system, [whole(log) for log in logs], system.settings.clips)
    assert Problem(system, pool, open_engine(system), 0).active.all()
