"""Opening engines, and what the engines of one process and of many do with a call."""

import signal
import subprocess
import sys
import time
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from threading import Timer

import numpy as np
import pytest

from amhe_cli.core.errors import AmheError, ConfigError
from amhe_cli.engine import cpu, spread
from amhe_cli.engine.open import contact_variants, open_engine
from amhe_cli.study.executors import remote
from tests.clusters import Cluster
from tests.engine.test_contract import CUBE, PENDULUM, clips, some


class Counting(ThreadPoolExecutor):
    """Counts the candidates of each part of a call."""

    def __init__(self) -> None:
        super().__init__(1)
        self.parts: list[int] = []

    def submit(self, fn, /, *args, **kwargs):
        self.parts.append(len(args[1]))
        return super().submit(fn, *args, **kwargs)


def test_an_unknown_engine_is_refused_with_those_that_there_are() -> None:
    with pytest.raises(ConfigError, match="no engine 'abacus'.*cpu"):
        open_engine(PENDULUM, kind="abacus")


@pytest.mark.medium
def test_looking_for_cards_prints_nothing() -> None:
    """Warp warns on stderr, once in a process, that it finds no driver."""
    pytest.importorskip("mujoco_warp")
    look = (
        "from amhe_cli.engine.open import open_engine\n"
        "from amhe_cli.system.system import System\n"
        "open_engine(System.load('pendulum'), kind='auto')"
    )
    ended = subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, check=True)
    assert ended.stdout + ended.stderr == ""


def test_a_call_is_spread_in_parts() -> None:
    with Counting() as executor:
        open_engine(PENDULUM, executor=executor).rollout(*some(50))
    assert len(executor.parts) == 6
    assert sum(executor.parts) == 50


@pytest.mark.parametrize(
    ("candidates", "count", "parts"), [(10, 3, [4, 3, 3]), (2, 24, [1] * 6), (1, 5, [1])]
)
def test_a_prediction_is_spread_by_candidates_and_those_of_few_by_clips(
    candidates: int, count: int, parts: list[int]
) -> None:
    starts, wanted = clips(PENDULUM, count)
    theta = some(candidates)[0]
    errors = np.random.default_rng(0).normal(size=(candidates, count, starts.first_index.size))
    alone = open_engine(PENDULUM).predict(theta, starts, errors, wanted)
    with Counting() as executor:
        spread = open_engine(PENDULUM, executor=executor).predict(theta, starts, errors, wanted)
    assert executor.parts == parts
    np.testing.assert_array_equal(spread.completed, alone.completed)
    for one, other in zip(spread.values, alone.values, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_worker_with_another_version_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with ThreadPoolExecutor(1) as executor:
        engine = open_engine(PENDULUM, executor=executor)
        theirs = {**spread.versions(), "python": "3", "mujoco": "3.9"}
        monkeypatch.setattr(spread, "versions", lambda: theirs)
        spread._engine.cache_clear()
        with pytest.raises(ConfigError, match=r"a worker runs mujoco 3\.9, and this command \d"):
            engine.rollout(*some(8))
        monkeypatch.undo()
        assert engine.rollout(*some(8)).completed.all()


class Hanging(Executor):
    """Answers nothing."""

    def submit(self, fn, /, *args, **kwargs):
        return Future()


def test_workers_that_hang_are_warned_of_and_given_up(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(spread, "_DOUBTED", 0.5)
    monkeypatch.setattr(spread, "_LOST", 1.5)
    with pytest.raises(AmheError, match=r"no worker has answered for \d s: start them again"):
        open_engine(PENDULUM, executor=Hanging()).rollout(*some(8))
    assert caplog.text.count("one may hang") == 1


@pytest.mark.medium
def test_a_worker_of_a_cluster_that_is_stopped_is_warned_of_and_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    pytest.importorskip("distributed")
    with Cluster(tmp_path) as cluster, remote(cluster.address) as executor:
        worker = cluster.worker()
        engine = open_engine(PENDULUM, executor=executor)
        assert engine.rollout(*some(8)).completed.all()
        monkeypatch.setattr(spread, "_DOUBTED", 1.0)
        monkeypatch.setattr(spread, "_LOST", 4.0)
        worker.send_signal(signal.SIGSTOP)
        begun = time.monotonic()
        with pytest.raises(AmheError, match=r"no worker has answered for \d s: start them again"):
            engine.rollout(*some(8))
        assert time.monotonic() - begun < 30.0
        assert caplog.text.count("one may hang") == 1


def test_ctrl_c_ends_a_call_whose_workers_hang(monkeypatch: pytest.MonkeyPatch) -> None:
    """To conclude a search takes workers: a KeyboardInterrupt would begin that, and wait again."""
    monkeypatch.setattr(spread, "_QUIET", 0.5)
    press = Timer(2.5, lambda: signal.raise_signal(signal.SIGINT))
    press.start()
    with pytest.raises(AmheError, match="interrupted while no worker had answered"):
        open_engine(PENDULUM, executor=Hanging()).rollout(*some(8))
    press.join()


@pytest.mark.medium
def test_sums_of_what_other_processes_predict_are_the_same_to_the_bit() -> None:
    """The rounding of a sum depends on the layout of its array in memory, which a pickle does not keep."""
    starts, wanted = clips(CUBE, 24)
    theta = CUBE.space.theta_of(np.random.default_rng(0).normal(0.0, 0.3, (40, 4)))
    alone = open_engine(CUBE)
    with ProcessPoolExecutor(2, get_context("spawn")) as executor:
        spread = open_engine(CUBE, executor=executor)
        for some_theta in (theta, theta[:2]):
            one, other = (engine.predict(some_theta, starts, None, wanted[:1]) for engine in (alone, spread))
            assert one.values[0].strides == other.values[0].strides
            squares = [np.einsum("pcsk,pcsk->pcs", done.values[0], done.values[0]) for done in (one, other)]
            np.testing.assert_array_equal(*squares)


def test_workers_that_are_gone_end_a_search_in_one_line() -> None:
    class Gone(Executor):
        def submit(self, fn, /, *args, **kwargs):
            raise BrokenExecutor

    with pytest.raises(AmheError, match="workers are gone.*checkpoint"):
        open_engine(PENDULUM, executor=Gone()).rollout(*some(3))


def test_memory_is_bounded_by_turns_which_change_no_number(monkeypatch: pytest.MonkeyPatch) -> None:
    starts, wanted = clips(PENDULUM)
    theta = some(10)[0]
    errors = np.random.default_rng(0).normal(size=(10, 3, starts.first_index.size))
    engine = open_engine(PENDULUM)
    at_once = engine.predict(theta, starts, errors, wanted)
    sizes: list[int] = []
    roll_out = engine.rollout
    engine.rollout = lambda theta, *rest: sizes.append(len(theta)) or roll_out(theta, *rest)  # type: ignore[method-assign]
    monkeypatch.setattr(cpu, "RECORD_BYTES", 9000)
    in_turns = engine.predict(theta, starts, errors, wanted)
    assert sum(sizes) == 30
    assert max(sizes) <= 9000 // (8 * 3 * starts.horizon), "qpos, qvel and input of each step"
    for one, other in zip(in_turns.values, at_once.values, strict=True):
        np.testing.assert_array_equal(one, other)


def test_contact_variants_are_the_given_engine_upon_softer_and_harder_contacts() -> None:
    class Noting:
        def __init__(self) -> None:
            self.models = []

        def upon(self, model):
            self.models.append(model)
            return len(self.models)

    engine = Noting()
    variants = contact_variants(engine, CUBE.model)  # type: ignore[arg-type]
    assert variants == {"contacts twice as soft": 1, "contacts twice as hard": 2}
    before = CUBE.model.pair_solref[0, 0]
    least = 2.0 * CUBE.model.opt.timestep
    assert [m.pair_solref[0, 0] for m in engine.models] == [2.0 * before, max(0.5 * before, least)]
