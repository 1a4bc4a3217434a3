"""The engine of graphics cards, by default on the processor: turns, several cards, buffers, refusals."""

from __future__ import annotations

import copy
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import warp as wp

import amhe_cli as amhe
from amhe_cli.cli.main import run
from amhe_cli.core.arrays import to_host
from amhe_cli.core.errors import NOTE, SimulationError
from amhe_cli.engine.auto import FEWEST, StepCost
from amhe_cli.engine.gpu import card
from amhe_cli.engine.gpu import engine as engine_module
from amhe_cli.engine.gpu.blueprint import Blueprint, Room
from amhe_cli.engine.gpu.card import Card
from amhe_cli.engine.gpu.engine import GpuEngine, compile_apart
from amhe_cli.engine.gpu.job import queues
from amhe_cli.engine.gpu.worlds import Worlds, load_together
from amhe_cli.engine.open import open_engine
from amhe_cli.engine.rollout import Starts, Wanted
from amhe_cli.estimation.offline import search
from amhe_cli.estimation.offline.clips import ClipPool, whole
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.estimation.uncertainty.fit import final_fit
from amhe_cli.system.system import System
from tests.engine.conftest import DEVICES
from tests.engine.test_contract import clips

pytestmark = pytest.mark.slow  # warp compiles its kernels, which takes half a minute the first time

PENDULUM = System.load("pendulum")
CUBE = System.load("cube_toss")


def on(system: System, *devices: str) -> GpuEngine:
    return GpuEngine(system.model, system.edits, system.input_spec, system.senses, devices or DEVICES)


def call(system: System, count: int = 5, clips: int = 4) -> tuple[Any, ...]:
    """A prediction of candidates on clips that begin above the floor, or at rest."""
    model, rng, horizon = system.model, np.random.default_rng(0), 20
    qpos = np.tile(model.qpos0, (clips, 1))
    if system is CUBE:
        qpos[:, :3] = (0.0, 0.0, 0.05)
    starts = Starts(
        qpos=qpos,
        qvel=0.1 * rng.normal(size=(clips, model.nv)),
        inputs=rng.normal(size=(clips, horizon, model.nu)),
        history=0,
        lengths=np.full(clips, horizon),
        first_index=np.arange(model.nv),
        first_sd=np.full((clips, model.nv), 0.01),
    )
    theta = system.space.theta_of(rng.normal(0.0, 0.3, (count, len(system.space))))
    errors = rng.normal(size=(count, clips, model.nv))
    wanted = [Wanted("qpos", rng.integers(0, horizon, (clips, 6)), tuple(range(model.nq)))]
    return theta, starts, errors, wanted


def test_a_prediction_in_turns_is_that_of_one(monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = call(PENDULUM)
    (whole,) = on(PENDULUM).predict(*arguments).values
    for at_once in (3, 8):
        monkeypatch.setattr(card, "WITHOUT_CARD", at_once)
        (parts,) = on(PENDULUM).predict(*arguments).values
        np.testing.assert_array_equal(to_host(parts), to_host(whole))


@pytest.mark.parametrize("system", [PENDULUM, CUBE], ids=["pendulum", "cube"])
def test_clips_in_one_queue_are_those_of_worlds_of_their_own(
    system: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever a world did before: a clip that diverges, and sensors, which lag a step behind."""
    spec = mujoco.MjSpec.from_file(str(system.folder / "scene.xml"))  # type: ignore[operator]
    spec.add_sensor(name="clock", type=mujoco.mjtSensor.mjSENS_CLOCK)
    model = spec.compile()
    engine = GpuEngine(model, system.edits.upon(model), system.input_spec, True, DEVICES)
    starts, wanted = clips(system, 5)
    starts.qvel[3] = np.nan
    wanted.append(replace(wanted[0], source="sensordata", columns=(0,)))
    theta = system.space.theta_of(np.random.default_rng(4).normal(0.0, 0.3, (3, len(system.space))))
    found = []
    each = np.arange(5)
    for dealt in (each[:, None], each[None, :]):
        monkeypatch.setattr(engine_module, "queues", lambda *arguments, dealt=dealt: dealt)
        found.append(engine.predict(theta, starts, None, wanted))
    apart, queued = found
    assert queued.completed.tolist() == apart.completed.tolist() == 3 * [[True, True, True, False, True]]
    for one, other in zip(apart.values, queued.values, strict=True):
        kept = [0, 1, 2, 4]  # the same to the bit here; sums on a card have no fixed order
        np.testing.assert_allclose(to_host(other)[:, kept], to_host(one)[:, kept], rtol=0.0, atol=1e-6)


def test_queues_take_the_least_time() -> None:
    lengths, many = np.array([50, 10, 30, 20]), FEWEST
    free, dear = StepCost(True, 1, 1.0, 1.0, 0.0), StepCost(True, 1, 1.0, 0.0, 1.0)
    assert queues(lengths, many, free).tolist() == [[0, -1], [2, -1], [3, 1]], "worlds cost nothing"
    assert sorted(queues(lengths, many, dear)[0].tolist()) == [0, 1, 2, 3], "steps of a world, and no wait"
    between = StepCost(True, 1, 1.0, 2.0, 1.0 / many)
    assert queues(lengths, many, between).tolist() == [[0, 1], [2, 3]]
    assert queues(lengths[:3], many, between).tolist() == [[0, -1], [2, 1]]


def test_no_clip_waits_to_save_worlds_that_a_card_steps_anyway() -> None:
    lengths, dear = np.array([50, 10, 30, 20]), StepCost(True, 1, 1.0, 0.0, 1.0)
    few = FEWEST // 4
    assert queues(lengths, few, dear).tolist() == [[0, -1], [2, -1], [3, 1]], "none after the longest"
    assert queues(lengths[:3], few, dear).tolist() == [[0, -1], [2, 1]], "no longer than the longest"


def test_all_modules_that_a_step_needs_are_loaded_side_by_side(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A first launch without effect finds them; a second one loads nothing more. Compiling is said once."""
    monkeypatch.setattr("amhe_cli.engine.gpu.worlds._compiled", lambda *about: False)
    caplog.set_level(NOTE, "amhe_cli")
    blueprint = Blueprint.of(CUBE.model, CUBE.edits, CUBE.input_spec, False)
    model, data = mjw.put_model(blueprint.model), mjw.make_data(blueprint.model, nworld=16)
    kind, loaded = type(wp.get_module("any")), []
    load = kind.load
    waited_for = []

    def loads(self: Any, *given: Any) -> Any:
        loaded.append(self)
        thread = threading.current_thread()
        waited_for.append(not thread.daemon and thread is not threading.main_thread())
        return load(self, *given)

    monkeypatch.setattr(kind, "load", loads)
    device = wp.get_device(DEVICES[0])

    def suggested(kernel: Any, *given: Any) -> tuple[int, int]:
        """As on a card: it takes the kernel, in the middle of the launches."""
        if kernel.module.load(device) is None:
            raise RuntimeError(f"Failed to load module for kernel {kernel.key}")
        return 1, 1

    monkeypatch.setattr(wp, "get_suggested_block_size", suggested)
    load_together(device, lambda: mjw.step(model, data), 2)
    assert not any(waited_for), "the end of the process waits for no thread that compiles"
    assert not data.time.numpy().any()
    assert len(together := set(loaded)) > 10
    assert caplog.text.count("kernels of the graphics card compile, once") == 1
    with wp.ScopedDevice(device):
        mjw.step(model, data)
    assert set(loaded) == together
    assert data.time.numpy().all()


def test_kernels_compile_apart_once_for_each_model(monkeypatch, tmp_path, caplog) -> None:
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    monkeypatch.setattr("amhe_cli.engine.gpu.engine.apart", lambda work: work())
    compiled = []
    monkeypatch.setattr(GpuEngine, "load", lambda self, *given: compiled.append((self._model, *given)))
    caplog.set_level(NOTE, "amhe_cli")
    other = copy.copy(PENDULUM.model)
    other.opt.timestep *= 0.5
    narrow = System.load("pendulum", {"parameters": {"load_mass": {"prior_sd": 0.01}}}).edits
    for edits, model in zip(
        (PENDULUM.edits, narrow, PENDULUM.edits, PENDULUM.edits),
        (PENDULUM.model, PENDULUM.model, other, PENDULUM.model),
        strict=True,
    ):
        edits = edits.upon(model)
        compile_apart((model, edits, PENDULUM.input_spec, False, DEVICES[:1]), 3000, 4)
    assert [(model.opt.timestep, *given) for model, *given in compiled] == [
        (PENDULUM.model.opt.timestep, 3000, 4),
        (other.opt.timestep, 3000, 4),
    ]
    assert caplog.text.count("compile with what cores have left") == 2


def test_arrays_of_a_card_are_made_on_that_card() -> None:
    """CuPy's current device is the first one in each thread: the stream of another one would be refused."""
    entered = []

    @contextmanager
    def entering(what: str, which: int) -> Iterator[None]:
        entered.append((what, which))
        yield

    stream = SimpleNamespace(from_external=partial(entering, "stream"))
    worlds: Any = object.__new__(Worlds)
    worlds._device = SimpleNamespace(is_cuda=True, ordinal=1, stream=7)
    worlds._xp = SimpleNamespace(cuda=SimpleNamespace(Device=partial(entering, "device"), Stream=stream))
    with worlds.stream():
        assert entered == [("device", 1), ("stream", 7)]


def test_several_cards_share_a_prediction(monkeypatch: pytest.MonkeyPatch) -> None:
    """One thread at a time uses each: what others launch there would be captured in its graphs."""
    monkeypatch.setattr(engine_module, "LEAST", 4)
    running, worlds, run = Counter[str](), Card.worlds, Worlds.run

    def begins(self: Card, *given: Any) -> Worlds:
        running[self._device] += 1
        time.sleep(0.05)
        assert running[self._device] == 1
        return worlds(self, *given)

    def ends(self: Worlds, job: Any) -> Any:
        done = run(self, job)
        running[str(self._device)] -= 1
        return done

    monkeypatch.setattr(Card, "worlds", begins)
    monkeypatch.setattr(Worlds, "run", ends)
    arguments = call(PENDULUM)
    (one,), (three,) = (on(PENDULUM, *n * DEVICES).predict(*arguments).values for n in (1, 3))
    np.testing.assert_array_equal(to_host(three), to_host(one))
    assert wp.get_device("cpu").runtime.core.wp_cuda_get_context_restore_policy(), "of the current card"


def test_numbers_of_another_card_are_copied_before_its_memory_is_used_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The copy runs on the first card's stream, and the other card does not wait for it."""
    done: list[str] = []
    stream = SimpleNamespace(synchronize=lambda: done.append("waited"))
    cuda = SimpleNamespace(Device=lambda which: nullcontext(), get_current_stream=lambda: stream)
    cupy = SimpleNamespace(cuda=cuda, array=lambda values: done.append("copied"))
    monkeypatch.setitem(sys.modules, "cupy", cupy)
    engine_module._gathered(SimpleNamespace(device=SimpleNamespace(id=1)))  # type: ignore[arg-type]
    assert done == ["copied", "waited"]


def test_buffers_that_are_too_small_are_made_larger(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A cube on the floor touches it at four corners."""
    arguments = call(CUBE)
    (expected,) = open_engine(CUBE).predict(*arguments).values
    monkeypatch.setattr(card, "first_room", lambda model: Room(1, 2))
    found = on(CUBE).predict(*arguments)
    assert found.completed.all()
    np.testing.assert_allclose(to_host(found.values[0]), expected, atol=1e-4)
    monkeypatch.setattr(card, "DOUBLINGS", 0)
    assert not on(CUBE).predict(*arguments).completed.all(), "contacts were left out, and it is marked"
    assert "the card has no room for all contacts" in caplog.text


@pytest.mark.parametrize(
    "error",
    [
        MemoryError("out of memory"),
        RuntimeError("Failed to allocate 8 bytes on device 'cuda:0'"),
        Exception("Failed to load CUDA module 'a'"),
    ],
)
def test_turns_get_smaller_where_the_memory_is_full(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    arguments = call(PENDULUM)
    (expected,) = on(PENDULUM).predict(*arguments).values
    asked, runs = [], Worlds.run

    def run(self: Worlds, job: Any) -> Any:
        asked.append(len(job.clip))
        if len(job.clip) > most:
            raise error
        return runs(self, job)

    monkeypatch.setattr(Worlds, "run", run)
    monkeypatch.setattr(Card, "at_once", lambda self, record: max(1, int(32 * self.part)))
    most = 8
    np.testing.assert_array_equal(to_host(on(PENDULUM).predict(*arguments).values[0]), to_host(expected))
    assert asked[0] > most >= max(asked[-3:])
    most, little = 0, "^the graphics card has too little free memory; take"
    with pytest.raises(SimulationError, match=little):
        on(PENDULUM).predict(*arguments)
    engine = on(PENDULUM)

    def refuses(*arguments: Any, **named: Any) -> None:
        raise error

    monkeypatch.setattr(card, "Worlds", refuses)
    with pytest.raises(SimulationError, match=little):
        engine.load(3, 1)
    monkeypatch.setattr("mujoco_warp.put_model", refuses)
    with pytest.raises(SimulationError, match=little):
        on(PENDULUM)


def test_an_estimate_is_that_of_the_processor() -> None:
    short = PENDULUM.settings.clips.model_copy(update={"count": 1, "length": (0.06, 0.06)})
    few = PENDULUM.settings.identify.model_copy(update={"iterations": 4})
    settings = PENDULUM.settings.model_copy(update={"clips": short, "identify": few})
    system = replace(PENDULUM, settings=settings)
    log = amhe.read_log(Path(__file__).parents[2] / "examples" / "logs" / "pendulum.mcap", system)
    fits = []
    for engine in (open_engine(system), on(system)):
        problem = Problem(system, ClipPool(system, [whole(log)], short), engine, 0)
        state = search.start(problem)
        while not state.done:
            state = search.advance(problem, state)
        fits.append(final_fit(problem, state))
    one, other = fits
    assert (one.posterior.sd < 0.5).any(), "the log knows something"
    assert (np.abs(other.z - one.z) < 0.2 * one.posterior.sd).all()
    np.testing.assert_allclose(other.posterior.sd, one.posterior.sd, rtol=0.1)


def solver(spec: Any) -> None:
    spec.option.solver = mujoco.mjtSolver.mjSOL_PGS


def pid(spec: Any) -> None:
    spec.actuators[0].set_to_pid(kp=1.0, ki=1.0)


def filtered(spec: Any) -> None:
    spec.actuators[0].set_to_position(kp=1.0, timeconst=0.1)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (solver, "mujoco-warp cannot simulate this model: .*PGS is unsupported"),
        (pid, "mujoco-warp cannot simulate this model: .*PID.* not supported"),
        (filtered, "filters and slews of actuators start at rest on a card"),
    ],
    ids=["solver", "PID", "filter"],
)
def test_a_model_that_the_cards_cannot_simulate_is_refused(change: Callable[[Any], None], why: str) -> None:
    """One line says what they lack; `auto` takes the processor then (test_auto.py)."""
    spec = mujoco.MjSpec.from_file(str(PENDULUM.folder / "scene.xml"))  # type: ignore[operator]
    change(spec)
    model = spec.compile()
    with pytest.raises(SimulationError, match=f"^{why}; take the engine 'cpu'$"):
        GpuEngine(model, PENDULUM.edits.upon(model), PENDULUM.input_spec, False, DEVICES)


def test_larger_worlds_serve_until_new_ones_would_have_cost_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[int] = []
    monkeypatch.setattr(card, "Worlds", lambda blueprint, size, *more, **named: made.append(size) or object())
    monkeypatch.setattr(card, "step_cost", lambda model: StepCost(True, 1, 1.0, 0.0, 1e-3 / FEWEST))
    monkeypatch.setattr(Card, "memory", 1)
    one = Card(Blueprint.of(PENDULUM.model, PENDULUM.edits, PENDULUM.input_spec, False), "cpu")
    one.worlds(3 * FEWEST, 100)
    for _ in range(4):
        one.worlds(2 * FEWEST, 100)  # a step takes 3 ms in place of 2
    assert made == [3 * FEWEST]
    one.worlds(2 * FEWEST, 100)
    assert made == [3 * FEWEST, 2 * FEWEST], "five calls have lost half a second"
    one.worlds(2 * FEWEST, 100)
    one.worlds(3 * FEWEST, 100)
    one.worlds(4 * FEWEST, 100)
    assert made == [3 * FEWEST, 2 * FEWEST, 4 * FEWEST]
    one.worlds(5 * FEWEST, 100)  # the fourth size: those of 2 go, which were used longest ago
    one.worlds(2 * FEWEST, 100)
    assert made[3:] == [5 * FEWEST], "one call has lost a tenth of a second"


def test_variants_begin_with_the_buffers_that_proved_large_enough() -> None:
    engine = on(CUBE)
    engine.cards[0].room = Room(99, 999)
    assert engine.upon(CUBE.model).cards[0].room == Room(99, 999)


def test_without_a_card_the_command_says_so_in_one_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("amhe_cli.engine.gpu.visible._counted", lambda: 0)
    log = Path(__file__).parents[2] / "examples" / "logs" / "pendulum.mcap"
    assert run(["identify", str(log), "--engine", "gpu", "-o", str(tmp_path / "out")]) == 1
    *_, line = capsys.readouterr().err.strip().splitlines()  # the first may be warp's own, of the driver
    assert line == "amhe identify: error: no graphics card that CUDA can use; take the engine 'cpu'"
