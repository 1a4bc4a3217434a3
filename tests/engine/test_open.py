"""Opening engines, and what they do with a call."""

import subprocess
import sys

import numpy as np
import pytest

from amhe_cli.core.errors import ConfigError
from amhe_cli.engine import cpu
from amhe_cli.engine.open import contact_variants, open_engine
from tests.engine.test_contract import CUBE, PENDULUM, clips, some


def test_an_unknown_engine_is_refused_with_those_that_there_are() -> None:
    with pytest.raises(ConfigError, match="no engine 'abacus'.*cpu"):
        open_engine(PENDULUM, kind="abacus")


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


def test_only_models_that_collide_have_contact_variants() -> None:
    assert contact_variants(open_engine(PENDULUM), PENDULUM.model) == {}


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
