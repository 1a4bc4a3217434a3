"""Which model? Paired ratios cover the truth, and words follow the intervals."""

import numpy as np
import pytest

from amhe_cli.estimation.core.result import AtHorizon
from amhe_cli.estimation.validation.horizon import ClipErrors, at_horizon, best_of, improves, verdict

NAMES = ("plain", "stribeck")


def errors(values: np.ndarray, column: str = "hip") -> ClipErrors:
    return ClipErrors("joints.position", column, "rad", values[None], np.ones(values.size))


def compared(one: np.ndarray, other: np.ndarray, horizon: float = 0.5, seed: int = 0) -> AtHorizon:
    return at_horizon(horizon, False, [[errors(one)], [errors(other)]], np.random.default_rng(seed))


def clips(seed: int, count: int = 15) -> np.ndarray:
    """Errors of clips that differ much in how hard they are."""
    return np.exp(np.random.default_rng(seed).normal(0.0, 1.0, count))


def test_pairing_sees_what_scatter_hides() -> None:
    hard = clips(0)
    noise = np.exp(np.random.default_rng(1).normal(0.0, 0.05, (2, hard.size)))
    found = compared(hard * noise[0], 0.8 * hard * noise[1])
    assert best_of([found]) == 1
    assert found.ratios[1, 0] == pytest.approx(0.8, abs=0.05)
    assert found.better(1, 0)
    text = verdict([found], NAMES, 1, 0)
    assert text.startswith("stribeck predicts better than plain: its error is smaller by ")
    assert text.endswith("after 0.5 s")


def test_models_alike_are_told_apart_as_often_as_promised() -> None:
    decided = 0
    for seed in range(200):
        noise = np.exp(np.random.default_rng([seed, 1]).normal(0.0, 0.3, (2, 15)))
        found = compared(clips(seed) * noise[0], clips(seed) * noise[1], seed=seed)
        decided += found.better(0, 1) or found.better(1, 0)
    assert decided / 200 < 0.2  # 5 % were wanted; a bootstrap over 15 uneven clips is somewhat narrow


def test_horizons_are_one_test() -> None:
    """Of models alike, over four horizons that each err by themselves."""
    kept = 0
    for seed in range(150):
        noise = np.exp(np.random.default_rng([seed, 2]).normal(0.0, 0.3, (4, 2, 15)))
        found = [compared(clips(seed) * a, clips(seed) * b, seed=seed) for a, b in noise]
        kept += improves(found, 0, 1)
    assert kept / 150 < 0.05
    assert improves([compared(0.8 * clips(0), clips(0)), compared(0.9 * clips(1), clips(1))], 0, 1)


def test_few_clips_cannot_tell() -> None:
    found = compared(clips(0, 3), 0.1 * clips(0, 3))
    assert np.isnan(found.lower).all()
    assert "fewer than 4 clips" in verdict([found], NAMES, 1, 0)


def test_horizons_that_contradict_each_other_are_both_named() -> None:
    hard = clips(0)
    early, late = compared(hard, 0.5 * hard, 0.1), compared(hard, 1.2 * hard, 2.0)
    text = verdict([early, late], NAMES, best_of([early, late]), 0)
    assert text == "stribeck predicts better than plain after 0.1 s, and worse after 2 s"


def test_a_diverged_prediction_loses_and_a_missing_one_does_not_count() -> None:
    hard = clips(0)
    diverged = hard.copy()
    diverged[3] = np.inf
    found = compared(hard, diverged)
    assert best_of([found]) == 0
    assert np.isfinite(found.ratios).all()
    missing = hard.copy()
    missing[:2] = np.nan
    assert compared(missing, hard).clips == hard.size - 2


def test_only_what_all_models_predict_counts() -> None:
    hard = clips(0)
    both = [[errors(hard), errors(9.0 * hard, "knee")], [errors(0.5 * hard)]]
    found = at_horizon(0.5, False, both, np.random.default_rng(0))
    assert list(found.errors) == [("hip", "rad")]
    assert found.ratios[1, 0] == pytest.approx(0.5)


@pytest.mark.filterwarnings("error")
def test_what_all_models_lose_and_what_nobody_measured_decides_nothing() -> None:
    hard = clips(0)
    lost = np.full(hard.size, np.inf)
    both = [[errors(hard), errors(lost, "knee")], [errors(0.5 * hard), errors(lost, "knee")]]
    found = at_horizon(2.0, False, both, np.random.default_rng(0))
    assert best_of([found]) == 1 and found.ratios[0, 1] > 1.0
    unmeasured = compared(np.full(15, np.nan), hard)
    assert unmeasured.clips == 0 and best_of([unmeasured, compared(hard[:2], 0.5 * hard[:2])]) == 1
    nothing = at_horizon(0.5, False, [[errors(hard)], [errors(hard, "knee")]], np.random.default_rng(0))
    assert not nothing.errors
