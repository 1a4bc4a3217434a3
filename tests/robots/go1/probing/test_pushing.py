"""A score, and the helm that follows it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from amhe_cli.robots.go1.behaviours.gait import Gait
from amhe_cli.robots.go1.behaviours.objective import BUMPER, Course
from amhe_cli.robots.go1.kinematics import HOME
from amhe_cli.robots.go1.probing.motions import (
    FASTEST,
    MOTIONS,
    WIDEST_OFFSET,
    Motion,
    Score,
    ScoreHelm,
    Segment,
    named_motion,
)
from amhe_cli.robots.go1.state import Body, State

TRY = Motion("try", "", (Segment(1.0, 0.25), Segment(0.5, -0.1), Segment(2.0, 0.2, 0.1)))


def state(time: float, gap: float = 0.0, box_yaw: float = 0.0) -> State:
    """Robot behind a box whose face is a gap [m] ahead of its bumper."""
    rest = np.zeros(3)
    turn = np.array([np.cos(0.5 * box_yaw), 0.0, 0.0, np.sin(0.5 * box_yaw)])
    box = Body(np.array([0.6, 0.0, 0.15]), turn, rest, rest)
    trunk = Body(np.array([0.6 - 0.15 - BUMPER - gap, 0.0, 0.28]), np.array([1.0, 0, 0, 0]), rest, rest)
    return State(time, trunk, box, HOME, np.zeros(12))


def helm(motion: Motion) -> ScoreHelm:
    return ScoreHelm(Score(motion), Course((0.6, 0.0), 0.0, 100.0), 0.15, 0.25)


def test_a_score_repeats_its_motion_behind_the_approach() -> None:
    score = Score(TRY)
    speeds = [score.at(t).speed for t in (0.5, 1.0, 2.1, 2.6, 4.6, 5.6, 99.0)]
    assert speeds == [0.2, 0.25, -0.1, 0.2, 0.25, -0.1, 0.25]
    assert score.at(1.0 + 1000 * 3.5).speed == 0.25, "to the instant, however long"


def test_surges_keep_step_with_the_trot() -> None:
    surge = named_motion("surge")
    assert surge.seconds == pytest.approx(Gait().period)


def test_the_helm_commands_the_scores_speed_and_place_of_the_push() -> None:
    assert helm(TRY).reference(state(1.5)).speed == 0.25
    beside = helm(TRY).reference(state(3.0, box_yaw=0.2))
    assert (beside.speed, beside.offset) == (0.2, 0.1)
    assert beside.box_yaw == pytest.approx(0.2), "the box may turn"


def test_only_a_box_that_is_touched_and_pushed_is_to_move() -> None:
    assert helm(TRY).reference(state(1.5)).pushing == 1.0
    assert helm(TRY).reference(state(1.5, gap=0.1)).pushing == 0.0
    assert helm(TRY).reference(state(2.2)).pushing == 0.0, "it backs off"


def test_a_lost_face_is_found_again_first() -> None:
    at = state(1.5)
    lost = replace(at, trunk=replace(at.trunk, position=at.trunk.position + np.array([0.0, 0.5, 0.0])))
    reference = helm(TRY).reference(lost)
    assert reference.pushing == 0.0
    assert reference.speed <= 0.0


def test_the_motions_and_any_other_stay_within_the_limits() -> None:
    for phase in (phase for motion in MOTIONS for phase in motion.phases):
        assert abs(phase.speed) <= FASTEST
        assert abs(phase.offset or 0.0) <= WIDEST_OFFSET
    wild = helm(Motion("wild", "", (Segment(5.0, 2.0, 1.0),))).reference(state(2.0))
    assert (wild.speed, wild.offset) == (FASTEST, WIDEST_OFFSET)
