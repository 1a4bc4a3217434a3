"""Samples written as messages are the samples that are read again."""

import resource
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from amhe_cli.core.errors import ConfigError
from amhe_cli.core.log import Samples, sampled
from amhe_cli.core.signals import Signal
from amhe_cli.logs import LogWriter, read_signals, survey
from amhe_cli.logs.messages.writer import message_type, write_samples
from tests.logs.log_makers import DT, SETTINGS

JOINTS = Signal("joints", "/joints", ("position", "velocity"), names=("hip", "knee"))
BODY = Signal("body", "/body", ("position", "orientation", "linear_velocity", "angular_velocity"))
PLACE = Signal("place", "/place", ("position", "orientation"), type="geometry_msgs/msg/PoseStamped")
IMU = Signal("imu", "/imu", ("angular_velocity", "linear_acceleration"), type="sensor_msgs/msg/Imu")
VOLTS = Signal("volts", "/volts", ("value",), is_input=True)
ALL = (JOINTS, BODY, PLACE, IMU, VOLTS)
WIDTHS = {"joints": 2, "volts": 3}


def some(signals: tuple[Signal, ...] = ALL, count: int = 40) -> Samples:
    rng, times = np.random.default_rng(0), DT * np.arange(1, count + 1)
    samples = {}
    for signal in signals:
        for quantity in signal.quantities:
            width = 4 if quantity == "orientation" else WIDTHS.get(signal.name, 3)
            values = rng.normal(size=(count, width))
            if quantity == "orientation":
                values /= np.linalg.norm(values, axis=1, keepdims=True)
            samples[signal.key(quantity)] = times, values
    return samples


def stamp(time: float) -> int:
    return round(1e9 * time)


def test_every_message_type_is_read_again_as_it_was_written(tmp_path: Path) -> None:
    samples, path = some(), tmp_path / "log.mcap"
    with LogWriter(path, {}) as log:
        write_samples(log, ALL, samples, stamp)
    read = read_signals(path, ALL, DT, SETTINGS)
    again = sampled(read)
    assert set(again) == set(samples)
    for key, (times, values) in samples.items():
        np.testing.assert_allclose(again[key][0] + 1e-9 * read.start_ns, times, atol=1e-9)
        np.testing.assert_allclose(np.abs((again[key][1] * values).sum()), (values**2).sum(), err_msg=key)
        if "orientation" not in key:  # whose sign is free
            np.testing.assert_allclose(again[key][1], values, atol=1e-12, err_msg=key)


def test_messages_lie_in_the_order_of_time_and_only_what_was_sampled_is_written(tmp_path: Path) -> None:
    late, early = np.array([0.3, 0.4]), np.array([0.1, 0.35])
    samples = {"volts.value": (late, np.ones((2, 3))), "joints.position": (early, np.ones((2, 2)))}
    with LogWriter(tmp_path / "log.mcap", {}) as log:
        write_samples(log, ALL, samples, stamp)
    with (tmp_path / "log.mcap").open("rb") as file:
        found = [(c.topic, m.log_time) for _, c, m in make_reader(file).iter_messages(log_time_order=False)]
    assert found == [
        ("/joints", 100_000_000), ("/volts", 300_000_000), ("/joints", 350_000_000), ("/volts", 400_000_000)
    ]  # fmt: skip


def test_a_type_that_cannot_be_written_is_refused_by_name() -> None:
    with pytest.raises(ConfigError, match=r"signal 'f' is of type x/msg/Foot; "):
        message_type(Signal("f", "/f", ("value",), type="x/msg/Foot"))
    with pytest.raises(ConfigError, match="signal 'f'"):
        message_type(Signal("f", "/f", ("position",), fields={"position": ("a.b",)}))


def test_what_was_written_before_the_disk_was_full_stays_readable(tmp_path: Path) -> None:
    path, names = tmp_path / "log.mcap", [str(number) for number in range(10_000)]
    noise = np.random.default_rng(0).normal(size=(60, len(names)))
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (3_000_000, before[1]))
        with LogWriter(path) as log:
            with pytest.raises(OSError, match="too large") as raised:
                for number, row in enumerate(noise):
                    log.joint_state("/joints", stamp(0.1 * number), names, row)
            log.diagnostics(stamp(7.0), 0, "the run itself ends well", {})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert raised.value.filename == str(path)
    assert [left.name for left in tmp_path.iterdir()] == ["log.mcap"]
    assert survey(path).topics[0].count > 10
