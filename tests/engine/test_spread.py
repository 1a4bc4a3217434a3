"""Rollouts by others are the same rollouts."""

from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest

from amhe_cli.core.errors import AmheError
from amhe_cli.engine.cpu import CpuEngine
from amhe_cli.engine.spread import SpreadEngine
from amhe_cli.system.system import System


def call(count: int):
    """An engine's arguments, and a call of rollouts of different lengths, one of them diverging."""
    system = System.load("pendulum", {}, warn=False)
    rng = np.random.default_rng(0)
    theta = system.space.nominal * np.exp(rng.normal(0.0, 0.2, (count, len(system.space))))
    qpos, qvel = rng.normal(size=(count, system.model.nq)), rng.normal(size=(count, system.model.nv))
    qvel[count // 2] = 1e12
    inputs = rng.normal(size=(count, 40, system.model.nu))
    about = (system.model, system.edits, system.input_spec)
    return about, system.senses, (theta, qpos, qvel, inputs, rng.integers(5, 41, count))


@pytest.mark.parametrize("count", [3, 50])
def test_spread_rollouts_are_the_same_to_the_bit(count: int) -> None:
    about, senses, asked = call(count)
    alone = CpuEngine(*about, 1, senses).rollout(*asked)
    with ProcessPoolExecutor(2, get_context("spawn")) as executor:
        spread = SpreadEngine(executor, *about, senses).rollout(*asked)
    for row, length in enumerate(asked[-1]):
        assert np.array_equal(spread.qpos[row, :length], alone.qpos[row, :length])
        assert np.array_equal(spread.qvel[row, :length], alone.qvel[row, :length])
    assert np.array_equal(spread.completed, alone.completed)
    assert not alone.completed.all()


def test_every_part_is_done_by_itself() -> None:
    about, senses, asked = call(50)
    parts: list[int] = []

    class Counting(ThreadPoolExecutor):
        def submit(self, fn, /, *args, **kwargs):
            parts.append(len(args[1]))
            return super().submit(fn, *args, **kwargs)

    with Counting(1) as executor:
        SpreadEngine(executor, *about, senses).rollout(*asked)
    assert len(parts) == 6
    assert sum(parts) == 50


def test_workers_that_are_gone_end_a_search_in_one_line() -> None:
    about, senses, asked = call(3)

    class Gone(Executor):
        def submit(self, fn, /, *args, **kwargs):
            raise BrokenExecutor

    with pytest.raises(AmheError, match="workers are gone.*--checkpoint"):
        SpreadEngine(Gone(), *about, senses).rollout(*asked)
