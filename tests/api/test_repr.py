"""What a notebook or a terminal shows of the main objects: one line."""

import numpy as np

import amhe_cli as amhe


def test_system_and_log_are_one_line() -> None:
    system = amhe.System.load("pendulum")
    times = np.arange(0.0, 1.0, 0.01)
    zeros = np.zeros((times.size, 1))
    log = amhe.Log.from_arrays(
        {
            "joints": {"time": times, "position": zeros, "velocity": zeros},
            "command": {"time": times, "position": zeros},
        },
        system,
    )
    assert repr(system).startswith("System('pendulum': parameters load_mass, ")
    assert repr(log).startswith("Log('arrays', 0.99 s at ")
    assert "joints.position (1)" in repr(log)
    assert "\n" not in repr(system) + repr(log)
