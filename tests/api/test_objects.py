"""The main objects in a notebook: one line each, and logs of one name are distinguished."""

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


def test_logs_of_one_name_are_distinguished_in_the_provenance() -> None:
    from amhe_cli.system.provenance import hashes

    system = amhe.System.load("pendulum")
    times = np.arange(0.0, 1.0, 0.01)
    logs = []
    for scale in (1.0, 2.0, 3.0):
        wave = scale * np.sin(times)[:, None]
        arrays = {"joints": {"time": times, "position": wave, "velocity": wave}}
        logs.append(amhe.Log.from_arrays(arrays | {"command": {"time": times, "position": wave}}, system))
    found = hashes(logs)
    assert list(found) == ["arrays", "arrays #2", "arrays #3"]
    assert len(set(found.values())) == 3
