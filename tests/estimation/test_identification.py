"""Identification as a whole."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from amhe_cli.core.errors import NOTE, ConfigError, EstimationError
from amhe_cli.core.log import Log
from amhe_cli.core.signals import Series
from amhe_cli.estimation.conclude import PARTS
from amhe_cli.estimation.identification import IdentifyOptions, identify
from amhe_cli.estimation.offline.checkpoint import _sum
from amhe_cli.estimation.offline.cma import MEMORY
from amhe_cli.logs import read_signals
from amhe_cli.system.system import System
from tests.estimation.conftest import CHEAP, TRUTH

#: What a model lacks is not looked for here.
pytestmark = pytest.mark.usefixtures("unexplained")


def found(result, name):
    return next(p for p in result.parameters if p.name == name)


@pytest.mark.medium
def test_recovers_the_truth_within_its_own_interval(pendulum, swing, caplog):
    result = identify(pendulum, [swing(8.0)], None, IdentifyOptions())
    for parameter, truth in zip(result.parameters, TRUTH, strict=True):
        assert abs(parameter.estimate - truth) < 4.0 * parameter.sd
        assert parameter.verdict == "identified"
        assert parameter.sd < 0.1 * parameter.prior_sd
    assert result.held_out is not None
    assert result.held_out.cost < 0.05 * result.held_out.initial_cost
    assert result.noise_scale["joints.position"] == pytest.approx(1.0, abs=0.15)
    assert not result.interrupted
    assert "before it settled" not in caplog.text, "the samples of a short search are wide; nothing moves"


@pytest.mark.medium
def test_noise_free_logs_give_the_exact_answer(pendulum, swing):
    result = identify(pendulum, [swing(4.0, noise=0.0)], None, IdentifyOptions())
    assert result.belief.estimate == pytest.approx(TRUTH, rel=2e-3)


@pytest.mark.medium
def test_of_a_short_log_the_held_out_part_judges_a_first_fit_and_then_all_is_fitted(pendulum, swing, caplog):
    log = swing(2.0)

    def by(**clips: float):
        changed = {"clips": pendulum.settings.clips.model_copy(update=clips)}
        other = replace(pendulum, settings=pendulum.settings.model_copy(update=changed))
        return identify(other, [log], None, IdentifyOptions())

    part, whole = by(), by(held_out=0.0)
    assert "held-out errors are those of a fit to the rest" not in caplog.text
    with caplog.at_level(NOTE):
        both = by(held_out_least=3)
    assert "held-out errors are those of a fit to the rest" in caplog.text
    assert both.held_out.cost == part.held_out.cost and both.validated.estimate == pytest.approx(
        part.belief.estimate, rel=1e-12
    )
    assert both.clips.fitted == whole.clips.fitted > part.clips.fitted
    sd = np.sqrt(np.diag(whole.belief.covariance))  # of log(value)
    away = [np.abs(np.log(one.belief.estimate / whole.belief.estimate)) / sd for one in (both, part)]
    assert away[0].max() < 0.2 < away[1].max()


@pytest.mark.medium
def test_cmaes_finds_the_same(pendulum, swing):
    log = swing(4.0)
    result = identify(pendulum, [log], None, IdentifyOptions(method="cmaes"))
    assert result.method == "cmaes"
    assert found(result, "load_mass").estimate == pytest.approx(TRUTH[0], rel=0.03)
    assert found(result, "armature").estimate == pytest.approx(TRUTH[3], rel=0.1)


@pytest.mark.medium
def test_the_seed_decides_and_threads_do_not(pendulum, swing):
    log = swing(3.0)
    one = identify(pendulum, [log], None, IdentifyOptions(seed=5, threads=1))
    two = identify(pendulum, [log], None, IdentifyOptions(seed=5, threads=3))
    other = identify(pendulum, [log], None, IdentifyOptions(seed=6))
    np.testing.assert_array_equal(one.belief.estimate, two.belief.estimate)
    np.testing.assert_array_equal(one.belief.covariance, two.belief.covariance)
    assert (one.belief.estimate != other.belief.estimate).any()


@pytest.mark.medium
def test_what_the_model_has_wrong_is_added_and_moves_nothing(pendulum, swing):
    log, identify_settings = swing(3.0), pendulum.settings.identify
    wrong = identify_settings.model_copy(update={"model_error": {"load_mass": 0.05}})
    settings = pendulum.settings.model_copy(update={"identify": wrong})
    plain = identify(pendulum, [log], None, IdentifyOptions())
    honest = identify(replace(pendulum, settings=settings), [log], None, IdentifyOptions())
    np.testing.assert_array_equal(plain.belief.estimate, honest.belief.estimate)
    before, after = (np.sqrt(np.diag(result.belief.covariance)) for result in (plain, honest))
    assert after[0] == pytest.approx(np.hypot(before[0], 0.05), rel=1e-5)
    np.testing.assert_allclose(
        honest.belief.covariance - plain.belief.covariance, np.diag([0.05**2, 0.0, 0.0, 0.0]), atol=1e-9
    )
    np.testing.assert_allclose(
        honest.belief.systematic - plain.belief.systematic, np.diag([0.05**2, 0.0, 0.0, 0.0]), atol=1e-9
    )


class CutError(RuntimeError):
    """Stands for a machine that goes down."""


@pytest.mark.medium
@pytest.mark.parametrize("method", ["linearised", "cmaes"])
def test_a_checkpoint_resumes_to_the_bit(pendulum, swing, tmp_path, method):
    log, file = swing(3.0), tmp_path / "search.json"
    few = pendulum.settings.identify.model_copy(update={"cmaes_iterations": 6})
    pendulum = replace(pendulum, settings=pendulum.settings.model_copy(update={"identify": few}))

    def cut(iteration, total):
        if iteration.number == 3:
            raise CutError

    whole = identify(pendulum, [log], None, IdentifyOptions(method))
    with pytest.raises(CutError):
        identify(pendulum, [log], None, IdentifyOptions(method, checkpoint=file), cut)
    resumed = identify(pendulum, [log], None, IdentifyOptions(method, checkpoint=file))
    np.testing.assert_array_equal(whole.belief.estimate, resumed.belief.estimate)
    np.testing.assert_array_equal(whole.belief.covariance, resumed.belief.covariance)
    assert whole.iterations == resumed.iterations


@pytest.mark.medium
def test_a_finished_search_without_first_states_is_gone_on_with(pendulum, swing, tmp_path):
    """Nothing is known of them, and nothing is what must come back."""
    settings = pendulum.settings
    never = settings.identify.model_copy(update={"first_state": "never"})
    system = replace(pendulum, settings=settings.model_copy(update={"identify": never}))
    options = IdentifyOptions(checkpoint=tmp_path / "search.json")
    first, again = (identify(system, [swing(3.0)], None, options) for _ in range(2))
    np.testing.assert_array_equal(first.belief.covariance, again.belief.covariance)


@pytest.mark.medium
def test_a_checkpoint_of_another_problem_is_refused(pendulum, swing, tmp_path):
    file = tmp_path / "search.json"
    identify(pendulum, [swing(3.0)], None, IdentifyOptions(checkpoint=file, max_time=1e-9))
    identify(pendulum, [swing(3.0)], None, IdentifyOptions(checkpoint=file))
    with pytest.raises(ConfigError, match="other logs"):
        identify(pendulum, [swing(3.0)], None, IdentifyOptions(checkpoint=file, seed=9))
    saved = file.read_text()
    for change in ([], "x", {"z": []}, None):
        file.write_text(json.dumps(json.loads(saved) | {"state": change}))
        with pytest.raises(ConfigError, match="its content was changed"):
            identify(pendulum, [swing(3.0)], None, IdentifyOptions(checkpoint=file))
    for text in (saved.replace('"number": ', '"number": 1', 1), "[" * 10**5, "[]", saved[:-9]):
        file.write_text(text)
        with pytest.raises(ConfigError, match="delete it"):
            identify(pendulum, [swing(3.0)], None, IdentifyOptions(checkpoint=file))
    file.write_text("not a checkpoint")
    with pytest.raises(ConfigError, match="delete it"):
        identify(pendulum, [swing(3.0)], None, IdentifyOptions(checkpoint=file))


ONE = {"array": [1.0], "shape": [1]}
NAN = {"array": [float("nan")] * 4, "shape": [4]}
FORGED = {
    "linearised": [
        {"z": []}, {"z": "x"}, {"z": ONE}, {"z": NAN}, {"record": []}, {"stage": "x"}, {"scale": {"a": "x"}},
        {"scale": {"a": 0.0}}, {"number": -1}, {"number": True}, {"settled": 3}, {"straight": "x"},
        {"shape": {"array": [1.0], "shape": [1, 1]}}, {"first": 3}, {"first": {"mean": ONE, "shape": ONE}},
        {"trail": ONE}, {"z": {"array": [], "shape": [10**400]}},
    ],
    "cmaes": [
        {"done": 3}, {"number": 0.5}, {"memory": 3}, {"memory": {"_mean": NAN}},
        {"memory": dict.fromkeys(MEMORY, ONE)},
    ],
}  # fmt: skip


@pytest.mark.medium
@pytest.mark.parametrize("method", FORGED)
def test_a_forged_checkpoint_whose_checksum_fits_is_refused(pendulum, swing, tmp_path, method):
    few = pendulum.settings.identify.model_copy(update={"cmaes_iterations": 2})
    pendulum = replace(pendulum, settings=pendulum.settings.model_copy(update={"identify": few}))
    options = IdentifyOptions(method, checkpoint=tmp_path / "search.json")
    identify(pendulum, [swing(3.0)], None, options)
    saved = json.loads(options.checkpoint.read_text())
    entry = saved["state"]["record"][-1]
    entries = [
        {"theta": [1.0]},
        {"theta": ["x"] * 4},
        {"cost": "x"},
        {"method": 3},
        {"rollouts": -1},
        {"cost": 10**400},
    ]
    more = {"memory": saved["state"].get("memory", {}) | {"tell": ONE}}  # it would be set on the optimizer
    for change in (*FORGED[method], more, *({"record": [entry | one]} for one in entries)):
        state = saved["state"] | change
        options.checkpoint.write_text(json.dumps(saved | {"state": state, "sum": _sum(state)}))
        with pytest.raises(ConfigError, match="delete it"):
            identify(pendulum, [swing(3.0)], None, options)


@pytest.mark.medium
def test_ctrl_c_keeps_the_best_so_far(pendulum, swing, caplog):
    def press(iteration, total):
        if iteration.number == 4:
            raise KeyboardInterrupt

    result = identify(pendulum, [swing(4.0)], None, IdentifyOptions(), press)
    assert result.interrupted
    assert len(result.iterations) == 4
    assert "interrupted" in caplog.text
    assert found(result, "load_mass").estimate == pytest.approx(TRUTH[0], rel=0.3)


def test_max_time_stops_the_search_and_leaves_out_slow_checks(pendulum, swing, caplog):
    result = identify(pendulum, [swing(3.0)], None, IdentifyOptions(max_time=1e-3))
    assert len(result.iterations) <= 1
    assert caplog.text.count("stopped the search") == 1
    skipped = (
        "error against horizon, covariance from wider samples, comparison of the logs' halves, "
        "what rests on assumed values"
    )
    first = "left no time for: search for a second minimum, held-out clips from fitted first states"
    assert caplog.text.count(f"{first}, {skipped}") == 1
    assert not any(
        advice in caplog.text for advice in ("identify.iterations", "the model may lack", "now fixed are")
    )
    assert result.held_out is not None


@pytest.mark.medium
def test_progress_goes_through_the_conclusion(pendulum, swing):
    seen = []
    result = identify(
        pendulum,
        [swing(2.0)],
        None,
        IdentifyOptions(),
        lambda iteration, total: seen.append((iteration, total)),
    )
    parts = [iteration for iteration, _ in seen if iteration.stage == "conclusion"]
    assert [iteration for iteration, _ in seen[: -len(parts)]] == list(result.iterations)
    numbers = [part.number - len(result.iterations) for part in parts]
    assert set(numbers) < set(range(1, PARTS + 1)) and numbers == sorted(numbers)
    assert numbers[-1] == PARTS and len(numbers) == PARTS - 1, "nothing is missing here"
    assert {total for _, total in seen[-len(parts) :]} == {len(result.iterations) + PARTS}


@pytest.mark.medium
def test_what_no_measurement_feels_is_held_at_its_prior(swing, caplog):
    """Friction loss of a joint that is also swung by a perfect servo would be felt; a mass that only scales
    with its inertia in free fall is not: the tossed cube."""
    system = System.load("cube_toss", {**CHEAP, "clips": {"count": 4, "length": [0.1, 0.2]}})
    log = fall(system)
    result = identify(system, [log], None, IdentifyOptions())
    mass = found(result, "mass")
    assert mass.verdict == "prior"
    assert mass.estimate == pytest.approx(0.37)
    assert mass.shrinkage == pytest.approx(0.0, abs=1e-9)
    assert "mass is held at its prior: no measurement in these logs depends on it" in caplog.text


@pytest.mark.medium
def test_first_states_before_a_contact_are_unknowns_in_the_last_iterations_alone():
    identify_settings = {**CHEAP["identify"], "iterations": 6, "polish": 2, "first_state": "polish"}
    clips = {"count": 3, "length": [0.1, 0.2]}
    system = System.load("cube_toss", {"clips": clips, "identify": identify_settings})
    result = identify(system, [fall(system)], None, IdentifyOptions(threads=1))
    assert [one.stage for one in result.iterations] == ["explore"] * 4 + ["polish"] * 2
    explored, shown, first, last = (one.rollouts for one in result.iterations[2:])
    assert shown > 1.5 * explored, "twelve more unknowns of a clip"
    assert last <= first and first / result.clips.fitted < shown / clips["count"], "which matter is known"
    friction = found(result, "friction")
    assert friction.lower < 0.3 < friction.upper
    assert friction.shrinkage > 0.75, "0.80 to 0.96 with seeds 0 to 4, as the jitter falls"


def fall(system, noise: float = 1e-4) -> Log:
    """A cube that falls flat and slides, measured with this noise [SI]."""
    from amhe_cli.engine.open import open_engine

    steps = 300
    engine = open_engine(system)
    qpos, qvel = np.array([[0, 0, 0.06, 1, 0, 0, 0.0]]), np.array([[0.8, 0.1, 0, 0, 0, 1.0]])
    theta = np.array(system.space.nominal)
    theta[0] = 0.3
    done = engine.rollout(theta[None], qpos, qvel, np.zeros((1, steps, 0)), np.array([steps]))
    yes = np.ones(steps, dtype=bool)
    parts = {
        "position": done.qpos[0, :, :3],
        "orientation": done.qpos[0, :, 3:],
        "linear_velocity": done.qvel[0, :, :3],
        "angular_velocity": done.qvel[0, :, 3:],
    }
    noisy = np.random.default_rng(0)
    series = {
        f"cube.{k}": Series(v + noisy.normal(0, noise, v.shape), yes, yes, tuple("wxyz"[: v.shape[1]]))
        for k, v in parts.items()
    }
    return Log(system.model.opt.timestep, series, "fall")


@pytest.mark.medium
def test_a_parameter_that_drifts_within_the_log_is_reported(pendulum, swing, caplog):
    heavier = TRUTH * [1.4, 1.0, 1.0, 1.0]
    result = identify(pendulum, [swing(10.0, later=heavier)], [swing(3.0)], IdentifyOptions())
    assert "values drift within the logs: their second half wants load_mass +" in caplog.text
    mass = found(result, "load_mass")
    assert mass.sd > 0.03  # honest: neither half's value is the log's
    assert mass.verdict == "model-sensitive"


def test_a_still_log_is_refused_in_words(pendulum):
    rows = 2000
    yes = np.ones(rows, dtype=bool)
    noise = np.random.default_rng(0).normal(0.0, 0.002, (rows, 1))
    still = Log(
        0.002,
        {
            "joints.position": Series(noise, yes, yes, ("hinge",)),
            "joints.velocity": Series(20 * noise, yes, yes, ("hinge",)),
            "command.position": Series(0.0 * noise, yes, yes, ("servo",)),
        },
        "still",
    )
    with pytest.raises(EstimationError, match="motionless"):
        identify(pendulum, [still], None, IdentifyOptions())


@pytest.mark.medium
def test_a_belief_is_a_prior(pendulum, swing):
    first = identify(pendulum, [swing(4.0, seed=1)], None, IdentifyOptions())
    second = identify(pendulum, [swing(4.0, seed=2)], None, IdentifyOptions(prior=first.belief))
    assert found(second, "load_mass").prior == pytest.approx(found(first, "load_mass").estimate)
    assert found(second, "load_mass").sd < found(first, "load_mass").sd


@pytest.mark.medium
def test_a_command_delay_is_found(swing, delayed):
    """The same swing logged with commands 13 ms early: the delay is the shift."""
    log = swing(6.0)
    shift = 6  # steps of 2 ms
    command = log["command.position"]
    early = Series(np.roll(command.values, -shift, axis=0), command.valid, command.sampled, command.columns)
    moved = Log(log.dt, {**log.series, "command.position": early}, "early")
    result = identify(delayed, [moved], None, IdentifyOptions())
    assert found(result, "delay").estimate == pytest.approx(shift * log.dt, abs=0.0015)
    assert found(result, "load_mass").estimate == pytest.approx(TRUTH[0], rel=0.02)


@pytest.mark.medium
def test_ctrl_c_while_concluding_still_gives_a_result(pendulum, swing, monkeypatch, caplog):
    from amhe_cli.estimation import conclude

    def press(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(conclude, "assumed", press)
    result = identify(pendulum, [swing(3.0)], None, IdentifyOptions())
    assert result.interrupted
    assert "checks are not complete" in caplog.text
    assert found(result, "load_mass").estimate == pytest.approx(TRUTH[0], rel=0.05)


@pytest.mark.medium
def test_a_search_cut_short_says_so_and_widens(pendulum, swing, caplog):
    short = replace(
        pendulum,
        settings=pendulum.settings.model_copy(
            update={"identify": pendulum.settings.identify.model_copy(update={"iterations": 1})}
        ),
    )
    result = identify(short, [swing(4.0)], None, IdentifyOptions())
    assert "stopped before it settled" in caplog.text
    for parameter, truth in zip(result.parameters, TRUTH, strict=True):
        assert abs(parameter.estimate - truth) < 4.0 * parameter.sd


DATA = Path(__file__).parents[2].parent / "shared" / "data" / "cube_tosses"


@pytest.mark.medium
@pytest.mark.skipif(not DATA.is_dir(), reason="the real tosses (../shared/data/cube_tosses) are not here")
def test_real_tosses_tell_friction_and_not_mass():
    system = System.load("cube_toss", {"identify": {"iterations": 10}, "clips": {"count": 12}})
    dt, logs = system.model.opt.timestep, sorted(DATA.glob("toss_*.mcap"))
    tosses = [read_signals(path, system.signals, dt, system.settings.logs) for path in logs]
    result = identify(system, tosses[:20], tosses[40:], IdentifyOptions(threads=2))
    found = {p.name: p for p in result.parameters}
    assert found["friction"].lower < 0.18 < found["friction"].upper  # as published
    assert 0.15 < found["friction"].estimate < 0.23
    assert found["mass"].verdict == "prior"
    inertia = found["inertia_scale"]
    assert inertia.verdict in ("weak", "model-sensitive"), "published as 1: the model is wrong"
    assert inertia.reasons[0].kind in ("parts", "repeats"), "its logs contradict each other, or the model"
    assert result.held_out is not None
    assert result.held_out.position_error_m < 0.010 < result.held_out.initial_position_error_m
