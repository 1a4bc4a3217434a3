"""Every engine, opened for a system: what the tests of all engines share."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import mujoco
import pytest

from amhe_cli.engine.open import open_engine
from amhe_cli.engine.rollout import Engine
from amhe_cli.system.system import System

#: Warp's names of the devices on which the engine of graphics cards is tested: TEST_DEVICES=cuda:0,cuda:1 has
#: it on two cards; by default it is warp's own processor device.
DEVICES = os.environ.get("TEST_DEVICES", "cpu").split(",")
#: How every engine is opened; `spread` gives it two worker processes. A new engine is one more line.
ENGINES: dict[str, dict[str, Any]] = {
    "one thread": {"threads": 1},
    "two threads": {"threads": 2},
    "two processes": {"spread": True},
    "warp": {"devices": DEVICES},
}

Open = Callable[..., Engine]


@pytest.fixture(scope="module")
def workers() -> Iterator[Executor]:
    with ProcessPoolExecutor(2, get_context("spawn")) as executor:
        yield executor


@pytest.fixture(
    params=[pytest.param(n, marks=pytest.mark.slow if n == "warp" else ()) for n in ENGINES], scope="module"
)
def opened(request: pytest.FixtureRequest) -> Open:
    """Opens the engine for a system, as `open_engine` does."""
    given = dict(ENGINES[request.param])
    if "devices" in given:
        return on_warp
    executor = request.getfixturevalue("workers") if given.pop("spread", False) else None
    return lambda system, **more: open_engine(system, executor=executor, **given, **more)


def on_warp(system: System, *, model: mujoco.MjModel | None = None, sensors: bool | None = None) -> Engine:
    """The engine of graphics cards on these devices, as `open_engine` makes it for all cards."""
    from amhe_cli.engine.gpu.engine import GpuEngine

    edits = system.edits if model is None else system.edits.upon(model)
    senses = system.senses if sensors is None else sensors
    return GpuEngine(model or system.model, edits, system.input_spec, senses, DEVICES)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Warp takes seconds to import, in each worker: only where slow tests run."""
    return (collection_path.name == "test_gpu.py" and "not slow" in config.option.markexpr) or None
