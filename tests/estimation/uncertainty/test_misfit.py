"""What the model does not explain: clips that are left out, what a misfit suspects, a search cut short."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import mujoco
import numpy as np

from amhe_cli.core.log import Log, Series
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.conclude import PARTS, conclude
from amhe_cli.estimation.offline import search
from amhe_cli.estimation.offline.clips import ClipPool, whole
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.estimation.offline.search import SearchState
from amhe_cli.estimation.offline.watch import Watch
from amhe_cli.estimation.uncertainty.fit import FinalFit, final_fit
from amhe_cli.estimation.uncertainty.misfit import (
    held_fixed,
    left_out,
    report_misfit,
    shared_by_joints,
    unexplained,
)
from amhe_cli.system.system import System
from tests.estimation.conftest import TRUTH


def changed(log: Log, key: str, change: Callable[[np.ndarray], np.ndarray]) -> Log:
    """The log with other values of one series between 2.45 and 2.9 s, within its fifth clip of 0.6 s."""
    old, time = log[key], np.arange(log.steps) * log.dt
    values = np.where(((time > 2.45) & (time < 2.9))[:, None], change(old.values), old.values)
    return Log(log.dt, {**log.series, key: Series(values, old.valid, old.sampled, old.columns)}, "swing")


def at_truth(pendulum: System, log: Log) -> tuple[Problem, SearchState]:
    """A search of a log that has found the truth."""
    pool = ClipPool(pendulum, [whole(log)], pendulum.settings.clips)
    problem = Problem(pendulum, pool, open_engine(pendulum), 0)
    return problem, search.restart(problem, pendulum.space.z_of(TRUTH))


def test_a_clip_that_is_left_out_and_contradicts_the_others_speaks_against_every_value(
    pendulum, swing, caplog
) -> None:
    problem, found = at_truth(pendulum, changed(swing(6.2), "command.position", np.negative))
    watch = Watch(lambda record, total: None, None, PARTS)
    watch.interrupted = True  # no other check
    fit = final_fit(problem, found)
    short = conclude(problem, found, fit, [], watch, problem.system.space)
    assert short.unexplained == (watch.short,) and "it was interrupted" in watch.short
    assert "the model may lack" not in caplog.text
    result = conclude(problem, replace(found, stage="done"), fit, [], watch, problem.system.space)
    assert {p.verdict for p in result.parameters} == {"model-sensitive"}
    (reason,) = result.unexplained
    assert "of swing 2.40-3.00 s by" in reason and "`cost.trim` leaves it out" in reason
    assert f"{reason}: no value is called identified" in caplog.text


def test_noise_in_a_clip_that_is_left_out_is_no_contradiction(pendulum, swing) -> None:
    """Sensors that show ten times their noise for a while, and a right model."""
    rng = np.random.default_rng(3)
    log = changed(swing(6.2), "joints.position", lambda values: values + rng.normal(0.0, 0.02, values.shape))
    problem, found = at_truth(pendulum, log)
    fit = final_fit(problem, found)
    assert [problem.clips[i].start * log.dt for i in np.flatnonzero(fit.weight == 0.0)] == [2.4]
    assert left_out(fit) == ()


#: Two hinges, each with a motor.
LEG = """
<mujoco><worldbody><body><joint name="hip"/><geom size="0.1"/>
<body pos="0 0 -0.2"><joint name="knee"/><geom size="0.1"/></body></body></worldbody></mujoco>
"""


def test_a_misfit_lists_what_is_fixed_and_no_cause_that_nothing_tested(pendulum, delayed) -> None:
    drive = ["the gain of servo", "the force limit of servo"]
    assert held_fixed(pendulum, "joints.position") == [*drive, "the commands' delay"]
    assert held_fixed(pendulum, "joints.effort")[0].startswith("the scale of joints.effort")
    assert held_fixed(delayed, "joints.position") == drive
    sure = delayed.fixing({"delay": 0.02})
    assert held_fixed(sure, "joints.position") == [*drive, "delay at 0.02"]
    pooled = {
        "unit": "N*m*s/rad", "nominal": 0.1, "bounds": [0.01, 1.0], "scale": "log", "prior_sd": 0.5,
        "targets": [{"joint": "hip", "set": "damping"}, {"joint": "knee", "set": "damping"}],
    }  # fmt: skip
    joints = {"joints": ["hip", "knee"], "noise": {"position": 0.01}}
    leg = System.from_model(
        mujoco.MjSpec.from_string(LEG), parameters={"damping": pooled}, signals={"q": joints}
    )
    assert held_fixed(leg, "joints.position") == ["damping as one value of 2 joints"]
    assert shared_by_joints(leg) == {"damping": 2} and shared_by_joints(pendulum) == {}


def test_a_gain_that_is_a_parameter_is_not_fixed(pendulum) -> None:
    gain = {
        "unit": "N*m/rad", "nominal": 4.0, "bounds": [1.0, 9.0], "scale": "log", "prior_sd": 0.5,
        "targets": [{"actuator": "servo", "set": "gain"}],
    }  # fmt: skip
    signals = {
        "joints": {"joints": ["hinge"], "noise": {"position": 0.002}},
        "command": {"actuators": {"servo": "hinge"}, "quantity": "position"},
    }
    free = System.from_model(pendulum.spec.copy(), parameters={"gain": gain}, signals=signals)
    assert held_fixed(free, "joints.position") == ["the force limit of servo", "the commands' delay"]


def of_wrong_armature(pendulum: System, log: Log) -> tuple[System, FinalFit]:
    """The last linearisation under an armature that is fixed at a wrong value."""
    system = pendulum.fixing({"armature": 0.007})
    problem = Problem(system, ClipPool(system, [whole(log)], system.settings.clips), open_engine(system), 0)
    return system, final_fit(problem, search.restart(problem, system.space.z_of(TRUTH[:3])))


def test_a_warning_names_three_things_and_counts_the_rest(pendulum, swing, caplog) -> None:
    report_misfit(*of_wrong_armature(pendulum, swing(4.0)))
    listed = "now fixed are the gain of servo, the force limit of servo, armature at 0.007 and 1 more"
    assert listed in caplog.text and "play" not in caplog.text


def test_no_noise_is_advised_that_is_larger_than_all_motion(pendulum, swing) -> None:
    log = swing(4.0)
    (reason, *_) = unexplained(*of_wrong_armature(pendulum, log))
    assert "declare what it misses, noise: {" in reason
    degrees = {
        key: replace(log[key], values=np.degrees(log[key].values)) for key in log.series if "joints" in key
    }
    (reason, *_) = unexplained(
        *of_wrong_armature(pendulum, Log(log.dt, {**log.series, **degrees}, "degrees"))
    )
    assert "joints.position" in reason and "noise: {" not in reason
