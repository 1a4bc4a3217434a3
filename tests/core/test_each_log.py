"""Values that differ from log to log: which unknowns there are, and what the model gets of them."""

from __future__ import annotations

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from amhe_cli.core.each_log import acting, check_logs, named, searched, trended, values_on
from amhe_cli.core.errors import ConfigError
from amhe_cli.core.log import Log
from amhe_cli.core.parameters import Parameter, ParameterSpace

MODEL = ParameterSpace(
    (
        Parameter("gain", "-", 1.0, 0.1, 10.0, True, 0.5),
        Parameter("friction", "N m", 0.2, 0.01, 1.0, True, 0.5),
        Parameter("bias", "rad", 0.0, -1.0, 1.0, False, 0.1),
    ),
    ((1.0, 0.0, 0.3), (0.0, 1.0, 0.0), (0.3, 0.0, 1.0)),
)


def log(name: str = "run", **stated: Any) -> Log:
    return Log(0.01, {}, name).with_(**stated)


def test_logs_that_say_nothing_change_nothing() -> None:
    assert searched(MODEL, [log(), log()]) is MODEL
    theta = np.ones((2, 3))
    assert values_on(log(), MODEL, MODEL, theta) is theta


def test_what_every_log_knows_is_not_searched() -> None:
    space = searched(MODEL, [log(known={"gain": 2.0}), log(known={"gain": 3.0})])
    assert space.names == ("friction", "bias")
    np.testing.assert_allclose(space.prior_covariance, np.eye(2))
    values = values_on(log(known={"gain": 3.0}), MODEL, space, np.array([[0.3, 0.1]]))
    np.testing.assert_array_equal(values, [[3.0, 0.3, 0.1]])


def test_what_one_log_knows_is_searched_in_the_others() -> None:
    one, other = log(known={"gain": 2.0}), log()
    space = searched(MODEL, [one, other])
    assert space is MODEL
    theta = np.array([[5.0, 0.3, 0.1]])
    np.testing.assert_array_equal(values_on(one, MODEL, space, theta), [[2.0, 0.3, 0.1]])
    np.testing.assert_array_equal(values_on(other, MODEL, space, theta), theta)
    np.testing.assert_array_equal(acting(one, MODEL, space), [False, True, True])


def test_each_log_has_an_unknown_of_its_own() -> None:
    logs = named([log("a", own=["friction"]), log("a", own=["friction"]), log("b", own={"friction": "B"})])
    space = searched(MODEL, logs)
    assert space.names == ("gain", "friction[a]", "friction[a 2]", "friction[B]", "bias")
    assert space.prior_covariance[0, 4] == 0.3
    assert {p.nominal for p in space.parameters if p.name.startswith("friction")} == {0.2}
    theta = np.array([[1.0, 0.1, 0.2, 0.4, 0.0]])
    assert [values_on(one, MODEL, space, theta)[0, 1] for one in logs] == [0.1, 0.2, 0.4]
    np.testing.assert_array_equal(acting(logs[1], MODEL, space), [True, False, True, False, True])
    stranger = values_on(log("c", own=["friction"]), MODEL, space, theta)
    assert stranger[0, 1] == pytest.approx(0.2)  # the geometric mean of the others


def test_what_the_prior_owes_to_the_model_stays_with_its_parameters() -> None:
    model = replace(MODEL, prior_systematic=((0.5, 0.0, 0.2), (0.0, 0.4, 0.0), (0.2, 0.0, 0.3)))
    space = searched(model, named([log("a", own=["friction"]), log("b", own=["friction"])]))
    assert space.names == ("gain", "friction[a]", "friction[b]", "bias")
    expected = [[0.5, 0.0, 0.0, 0.2], [0.0] * 4, [0.0] * 4, [0.2, 0.0, 0.0, 0.3]]
    np.testing.assert_array_equal(space.prior_systematic, expected)


def test_logs_of_one_owner_share_a_value() -> None:
    logs = [log(own={"bias": "A"}), log(own={"bias": "A"}), log(own=["bias"]), log(known={"bias": 0.1})]
    check_logs(logs, [log()], MODEL)  # one that is held out has the common mean
    assert searched(MODEL, named(logs)).names == ("gain", "friction", "bias[A]", "bias[run]")


@pytest.mark.parametrize(
    ("logs", "text"),
    [
        ([log("a", own=["bias"]), log("b", own=["bias"]), log("c")], "c: `own`: bias is a's own; give it to"),
        ([log("a", own={"bias": "A"}), log("b", own={"bias": "A"})], "a: `own`: bias has one owner"),
        ([log("a", own=["bias"]), log("b", known={"bias": 0.1})], "a: `own`: bias has one owner"),
    ],
)
def test_values_of_some_logs_only_are_refused(logs: list[Log], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        check_logs(logs, [], MODEL)


def test_logs_that_know_everything_leave_nothing_to_search() -> None:
    known = {"gain": 1.0, "friction": 0.2, "bias": 0.0}
    with pytest.raises(ConfigError, match="`known`: the logs know every parameter: leave one unknown"):
        check_logs([log(known=known), log(known=known)], [], MODEL)


def test_a_log_keeps_what_is_said_of_it() -> None:
    one = log(known={"gain": 2.0}, own=["bias"], held_out=True)
    again = pickle.loads(pickle.dumps(one.with_()))
    assert (again.known, again.own, again.held_out) == ({"gain": 2.0}, {"bias": ""}, True)
    assert one.digest() != log().digest()


@pytest.mark.parametrize(
    ("stated", "text"),
    [
        ({"known": {"gian": 1.0}}, "run: `known`: no parameter 'gian' (did you mean 'gain'?)"),
        ({"known": {"gain": 99.0}}, "run: `known`: gain is 99; between 0.1 and 10 would be valid"),
        ({"own": ["drag"]}, "run: `own`: no parameter 'drag'"),
        ({"own": ["gain"], "known": {"gain": 1.0}}, "run: `own`: gain is known in this log"),
    ],
)
def test_what_the_system_does_not_have_is_refused(stated: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError) as raised:
        check_logs([log(**stated)], [], MODEL)
    assert text in str(raised.value)


def test_a_held_out_log_needs_what_the_others_know() -> None:
    with pytest.raises(ConfigError, match="test: `known`: gain is known in every fitted log"):
        check_logs([log(known={"gain": 1.0})], [log("test")], MODEL)


def test_a_trend_is_two_unknowns_between_which_each_log_has_its_place() -> None:
    logs = [log(trend={"friction": at, "bias": at}) for at in (0.0, 0.25, 1.0)] + [
        log(known={"friction": 0.5})
    ]
    logs[-1] = logs[-1].with_(trend={"bias": 0.5, "friction": 0.5})
    check_logs(logs, [log()], MODEL)
    space = searched(MODEL, logs)
    assert space.names == ("gain", "friction[start]", "friction[end]", "bias[start]", "bias[end]")
    theta = np.array([[1.0, 0.1, 0.4, 0.0, 0.8]])
    found = np.array([values_on(one, MODEL, space, theta)[0, 1:] for one in logs])
    np.testing.assert_allclose(found[:, 0], [0.1, 0.1 * 4**0.25, 0.4, 0.5])  # straight in the logarithm
    np.testing.assert_allclose(found[:, 1], [0.0, 0.2, 0.8, 0.4])
    np.testing.assert_allclose(values_on(log(), MODEL, space, theta)[0, 1:], [0.2, 0.4])  # the middle
    assert logs[1].digest() != logs[2].digest()


def test_the_places_on_a_trend_are_those_of_the_stamps() -> None:
    hour = 3600 * 10**9
    logs = [replace(log(), start_ns=1_700_000_000 * 10**9 + hours * hour) for hours in (2, 0, 8)]
    assert [one.trend for one in trended(logs, ["gain"])] == [{"gain": at} for at in (0.25, 0.0, 1.0)]
    with pytest.raises(ConfigError, match="`trend`: gain: needs logs, or parts of one, of different times"):
        trended(logs[:1], ["gain"])


@pytest.mark.parametrize("more", [{}, {"trend": {"bias": 0.0}}, {"own": ["bias"], "trend": {"bias": 1.0}}])
def test_a_trend_of_some_logs_only_is_refused(more: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="run: `trend`: bias needs two places or more"):
        check_logs([log(trend={"bias": 0.0}), log(**more)], [], MODEL)
