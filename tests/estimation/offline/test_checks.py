"""How far details of contact that nobody measured may move an estimate."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from amhe_cli.core.log import Log
from amhe_cli.core.parameters import Parameter, ParameterSpace
from amhe_cli.core.series import Series
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.offline import search
from amhe_cli.estimation.offline.checks import HALVES, left_out, report_drift, shared_by_joints, suspects
from amhe_cli.estimation.offline.clips import ClipPool, whole
from amhe_cli.estimation.offline.conclude import PARTS, conclude
from amhe_cli.estimation.offline.identification import IdentifyOptions, identify
from amhe_cli.estimation.offline.posterior import Disagreement, final_fit
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.estimation.offline.search import SearchState
from amhe_cli.estimation.offline.shifts import allowed, shifts_of
from amhe_cli.estimation.offline.verdicts import Shift
from amhe_cli.estimation.offline.watch import Watch
from amhe_cli.system.system import System
from tests.estimation.offline.conftest import CHEAP, TRUTH
from tests.estimation.offline.test_identification import fall


def test_a_change_is_allowed_until_the_misfit_has_risen_by_nine() -> None:
    assert [allowed(rise) for rise in (-5.0, 0.0, 9.0)] == [1.0, 1.0, 1.0]
    assert allowed(36.0) == pytest.approx(0.5), "the misfit rises with the square of the change"


def shifted(noise: float, executor: Executor | None = None) -> list[Shift]:
    """Shifts of a sliding cube's estimate at the truth, in a log with this noise [SI]."""
    system = System.load("cube_toss", {**CHEAP, "clips": {"count": 4, "length": [0.1, 0.2]}})
    channels = tuple(replace(channel, noise=noise) for channel in system.channels)
    system = replace(system, channels=channels)
    engine = open_engine(system, executor=executor)
    problem = Problem(
        system, ClipPool(system, [whole(fall(system, noise))], system.settings.clips), engine, 0
    )
    z = np.zeros(len(system.space))
    z[0] = system.space.z_of(np.array([0.3, *system.space.nominal[1:]]))[0]
    state = search.restart(problem, z)
    return shifts_of(problem, final_fit(problem, state))[0]


def test_a_sharp_log_that_rules_soft_contacts_out_is_not_widened_by_them() -> None:
    # of a blunt log, jitter decides which of the contacts explains it no worse
    sharp, blunt = shifted(1e-4), [*shifted(1e-2), *shifted(2e-2)]
    sharp, blunt = ([s.text for s in found if "contacts" in s.text] for found in (sharp, blunt))
    assert all("as far as the log allows" in text for text in sharp)
    assert any("as far as the log allows" not in text for text in blunt)


@pytest.mark.medium
def test_variants_are_rolled_out_by_the_workers_that_were_given() -> None:
    models: set[bytes] = set()

    class Noting(ThreadPoolExecutor):
        def submit(self, fn, /, *args, **kwargs):
            models.add(args[0])
            return super().submit(fn, *args, **kwargs)

    with Noting(1) as executor:
        spread = shifted(1e-4, executor)
    assert len(models) == 5, "the model itself, softer, harder, at half the step, solved for longer"
    for one, other in zip(shifted(1e-4), spread, strict=True):
        np.testing.assert_array_equal(one.z, other.z)


def test_one_of_many_parameters_drifts_only_where_chance_does_not_explain_it(caplog) -> None:
    many = [Parameter(f"friction{i}", "-", 0.5, 0.01, 5.0, True, 0.5) for i in range(49)]
    halves = {HALVES: Disagreement(np.array([3.2, *[1.0] * 48]), np.eye(49))}
    report_drift(ParameterSpace(tuple(many)), halves)
    assert "drifts" not in caplog.text
    report_drift(ParameterSpace(tuple(many[:1])), {HALVES: Disagreement(np.array([3.2]), np.eye(1))})
    assert "friction0 drifts within the logs" in caplog.text


@pytest.mark.medium
def test_a_search_is_unsettled_only_while_its_cost_still_falls(caplog, pendulum, swing) -> None:
    """The samples of a short search are still wide; its estimate moves no more."""
    identify(pendulum, [swing(3.0)], None, IdentifyOptions())
    assert "before it settled" not in caplog.text
    hasty = pendulum.settings.identify.model_copy(update={"iterations": 3, "polish": 1})
    settings = pendulum.settings.model_copy(update={"identify": hasty})
    identify(replace(pendulum, settings=settings), [swing(3.0)], None, IdentifyOptions())
    assert "before it settled" in caplog.text


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


@pytest.mark.medium
def test_a_clip_that_is_left_out_and_contradicts_the_others_speaks_against_every_value(
    pendulum, swing, caplog
) -> None:
    problem, found = at_truth(pendulum, changed(swing(6.2), "command.position", np.negative))
    watch = Watch(lambda record, total: None, None, PARTS)
    watch.interrupted = True  # no other check
    short = conclude(problem, found, [], watch)
    assert short.unexplained == (watch.short,) and "it was interrupted" in watch.short
    assert "the model may lack" not in caplog.text
    result = conclude(problem, replace(found, stage="done"), [], watch)
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


def test_a_misfit_suspects_what_is_no_parameter_yet(pendulum, delayed) -> None:
    assert suspects(pendulum, "joints.position") == ["a delay", "a gain", "play", "a contact"]
    assert "if it holds currents" in suspects(pendulum, "joints.effort")[0]
    assert suspects(delayed, "joints.position") == ["a gain", "play", "a contact"]
    pooled = {
        "unit": "N*m*s/rad", "nominal": 0.1, "bounds": [0.01, 1.0], "scale": "log", "prior_sd": 0.5,
        "targets": [{"joint": "hip", "set": "damping"}, {"joint": "knee", "set": "damping"}],
    }  # fmt: skip
    joints = {"joints": ["hip", "knee"], "noise": {"position": 0.01}}
    leg = System.from_model(
        mujoco.MjSpec.from_string(LEG), parameters={"damping": pooled}, signals={"q": joints}
    )
    assert suspects(leg, "joints.position")[0] == "values of their own for the joints that share damping"
    assert shared_by_joints(leg) == {"damping": 2} and shared_by_joints(pendulum) == {}
