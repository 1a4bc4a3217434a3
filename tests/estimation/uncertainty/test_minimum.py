"""Two minima: they are found from the prior's corners, named, and leave no value identified."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.estimation import conclude
from amhe_cli.estimation.core.result import Identification
from amhe_cli.matching.cost import MatchingCost

STEP, NOISE, TRUE = 0.005, 2e-3, 0.12
#: A wheel about the vertical: its inertia shows how far from the axis its load is, and not on which side.
XML = f"""<mujoco><option timestep="{STEP}" integrator="implicitfast"/><worldbody><body>
  <joint name="drive" axis="0 0 1" armature="0.002" damping="0.05"/>
  <geom type="sphere" size="0.01" mass="0.001" contype="0" conaffinity="0"/>
  <body name="load"><inertial pos="0.03 0 0" mass="0.5" diaginertia="1e-4 1e-4 1e-4"/></body>
  </body></worldbody>
  <actuator><position name="drive" joint="drive" kp="3"/></actuator></mujoco>"""


def wheel(lowest: float, tilt: float = 0.0) -> amhe.System:
    """The load's place is unknown, on either side of the axis or on one; a tilt tells them apart."""
    place = {
        "nominal": 0.03, "bounds": [lowest, 0.3], "scale": "linear", "prior_sd": 0.1,
        "targets": [{"body": "load", "set": "center_of_mass", "axis": "x"}],
    }  # fmt: skip
    damping = {"scale": "log", "prior_sd": 0.5, "targets": [{"joint": "drive", "set": "damping"}]}
    return amhe.System.from_model(
        mujoco.MjSpec.from_string(XML.replace('axis="0 0 1"', f'axis="0 {tilt} 1"')),
        parameters={"place": place, "damping": damping},
        signals={
            "joints": {"joints": ["drive"], "noise": {"position": NOISE}},
            "command": {"actuators": ["drive"], "quantity": "position"},
        },
        settings={"clips": {"length": [0.4, 0.8]}, "identify": {"assumed": 0}},
        warn=False,
    )


def identified(lowest: float, true: float = TRUE, tilt: float = 0.0) -> Identification:
    """The result of a log of a sweep."""
    system, rng = wheel(lowest, tilt), np.random.default_rng(0)
    model = system.edits.apply(system.model, np.array([true, 0.07]))
    data, clock = mujoco.MjData(model), STEP * np.arange(1600)
    command = 0.4 * np.sin(2.0 * np.pi * (0.5 + 0.25 * clock) * clock)
    position = np.empty_like(clock)
    for k, target in enumerate(command):
        position[k], data.ctrl[0] = data.qpos[0], target
        mujoco.mj_step(model, data)
    position += NOISE * rng.standard_normal(len(clock))
    log = amhe.Log.from_arrays(
        {"joints": {"time": clock, "position": position}, "command": {"time": clock, "position": command}},
        system,
    )
    return amhe.identify(system, [log], seed=0).found


@pytest.mark.medium
def test_both_sides_of_an_axis_are_named(caplog: pytest.LogCaptureFixture) -> None:
    place, damping = identified(-0.3).parameters
    assert (place.verdict, damping.verdict) == ("weak", "identified")
    assert place.reasons[0].text.startswith("another minimum explains the logs too: -0.12 m (cost ")
    assert place.estimate == pytest.approx(TRUE, rel=0.01)
    # 0.9 and -1.5 prior sd from the prior, and nearly alike for the logs
    share = 1.0 / (1.0 + np.exp(0.5 * (1.5**2 - 0.9**2)))
    assert place.sd == pytest.approx(np.sqrt(share) * 2.0 * TRUE, rel=0.2)
    (warning,) = (text for text in caplog.messages if "minima" in text)
    assert warning.startswith("two minima explain the logs: place 0.12 (cost ")
    assert ", and place -0.12 (cost " in warning


@pytest.mark.medium
def test_one_side_alone_is_identified(caplog: pytest.LogCaptureFixture) -> None:
    place, damping = identified(0.0).parameters
    assert (place.verdict, damping.verdict) == ("identified", "identified")
    assert not any("minima" in text for text in caplog.messages)


@pytest.mark.medium
def test_the_search_goes_on_from_the_better_minimum(caplog: pytest.LogCaptureFixture) -> None:
    """The prior leads to the wrong side, where the tilt costs a few noise sd."""
    place, _ = identified(-0.3, -TRUE, tilt=0.0003).parameters
    assert place.estimate == pytest.approx(-TRUE, rel=0.01)
    (warning,) = (text for text in caplog.messages if "minima" in text)
    assert warning.startswith("two minima explain the logs: place -0.12 (cost ")


@pytest.mark.medium
def test_looking_for_it_takes_a_tenth_of_the_rollouts(monkeypatch: pytest.MonkeyPatch) -> None:
    counted, looking = {True: 0, False: 0}, [False]
    residuals, second = MatchingCost.residuals, conclude.second_minimum

    def count(self, z, first=None):
        counted[looking[0]] += len(z) * len(self.clips.windows)
        return residuals(self, z, first)

    def look(*arguments):
        looking[0] = True
        found = second(*arguments)
        looking[0] = False
        return found

    monkeypatch.setattr(MatchingCost, "residuals", count)
    monkeypatch.setattr(conclude, "second_minimum", look)
    identified(0.0)
    assert 0 < counted[True] < 0.1 * counted[False]
