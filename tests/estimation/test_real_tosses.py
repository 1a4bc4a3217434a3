"""Real tosses of a cube, where the data are beside the project: friction is found, mass is not."""

from pathlib import Path

import pytest

from amhe_cli.estimation.identification import IdentifyOptions, identify
from amhe_cli.logs import read_signals
from amhe_cli.system.system import System

DATA = Path(__file__).parents[2].parent / "shared" / "data" / "cube_tosses"


@pytest.mark.skipif(not DATA.is_dir(), reason="the real tosses (../shared/data/cube_tosses) are not here")
def test_real_tosses_tell_friction_and_not_mass():
    system = System.load(
        "cube_toss",
        {"identify": {"iterations": 10, "profile_points": 0}, "clips": {"count": 12}},
    )
    dt, logs = system.model.opt.timestep, sorted(DATA.glob("toss_*.mcap"))
    tosses = [read_signals(path, system.signals, dt, system.settings.logs) for path in logs]
    result = identify(system, tosses[:20], tosses[40:], IdentifyOptions(threads=2))
    found = {p.name: p for p in result.parameters}
    assert found["friction"].lower < 0.18 < found["friction"].upper  # as published
    assert 0.15 < found["friction"].estimate < 0.23
    assert found["mass"].verdict == "prior"
    assert found["inertia_scale"].verdict == "model-sensitive", "published as 1: the model is wrong"
    assert result.held_out is not None
    assert result.held_out.position_error_m < 0.010 < result.held_out.initial_position_error_m
