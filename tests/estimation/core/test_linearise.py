"""Linearisation, and the elimination of what each clip has for itself."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from amhe_cli.core.arrays import FloatArray, to_host
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.core.information import (
    Information,
    _pull,
    clip_weights,
    fitted_noise_scale,
    gauss_newton_step,
    information,
    marginalised,
    mean_squares,
    noise_scale,
    weights,
)
from amhe_cli.estimation.core.linearise import FirstStates, Linearisation, averaged, linearise, without_jitter
from amhe_cli.estimation.offline.clips import ClipPool, whole
from amhe_cli.matching.cost import MatchingCost
from tests.estimation.conftest import TRUTH


@pytest.fixture(scope="module")
def cost(pendulum, swing) -> MatchingCost:
    windows = ClipPool(pendulum, [whole(swing(3.0))], pendulum.settings.clips).cut(0.5)
    engine = open_engine(pendulum)
    return MatchingCost(pendulum, windows, engine, pendulum.settings.cost)


def about(
    cost: MatchingCost, first: FirstStates, z: FloatArray | None = None, *, mean: bool = False
) -> Linearisation:
    """Linearised at the truth, or at z (d,)."""
    place = cost.system.space.z_of(TRUTH) if z is None else z
    rng, shape = np.random.default_rng(0), 0.02 * np.eye(place.size)
    found = linearise(cost, place, first, shape, 0, rng)
    return averaged(found, shape) if mean else found


def test_slopes_are_of_the_first_state_whatever_the_shape_of_its_samples(cost: MatchingCost) -> None:
    clips, nx, rng = len(cost.clips.windows), cost.nx, np.random.default_rng(1)
    plain = about(cost, FirstStates.recorded(clips, nx))
    narrow = np.tril(0.3 * rng.standard_normal((clips, nx, nx))) + 0.3 * np.eye(nx)
    shaped = about(cost, FirstStates(np.zeros((clips, nx)), narrow))
    error = np.sqrt(np.mean((shaped.gain - plain.gain) ** 2, axis=(0, 2)))
    size = np.sqrt(np.mean(plain.gain**2, axis=(0, 2)))
    assert (error < 0.15 * size).all(), error / size


def test_what_is_known_of_first_states_is_their_posterior(cost: MatchingCost) -> None:
    """Its mean moves with z, and none is wider than the prior."""
    found = information(about(cost, FirstStates.recorded(len(cost.clips.windows), cost.nx)))
    step = np.array([0.1, 0.0, -0.2, 0.0])
    known = found.first_states(step, 0.0)
    covariance = known.shape @ known.shape.transpose(0, 2, 1)
    ones = np.broadcast_to(np.eye(cost.nx), covariance.shape)
    np.testing.assert_allclose(covariance @ found.nuisance_precision, ones, atol=1e-8)
    np.testing.assert_allclose(known.mean, found.first(step[None])[0])
    assert np.linalg.eigvalsh(covariance).max() <= 1.0 + 1e-9


def test_samples_of_first_states_are_no_narrower_than_asked(cost: MatchingCost) -> None:
    found = information(about(cost, FirstStates.recorded(len(cost.clips.windows), cost.nx)))
    free, held = (found.first_states(np.zeros(4), floor) for floor in (0.0, 0.7))
    sd = [np.linalg.svd(known.shape, compute_uv=False) for known in (free, held)]
    assert sd[0].min() < 0.6
    np.testing.assert_allclose(sd[1], np.maximum(sd[0], 0.7))
    np.testing.assert_array_equal(held.mean, free.mean)


def test_errors_of_first_states_that_hardly_matter_are_not_sampled() -> None:
    """What matters on a window decides there; on others, what matters on most windows."""
    felt = np.array([[3.0, 0.3, 0.1], [0.1, 3.0, 0.05]])  # by three errors, on two windows
    slopes = np.sqrt(felt)[..., None] * np.eye(3)
    one = np.ones((2, 3))
    known = marginalised(np.zeros((2, 3)), np.zeros((2, 1, 3)), slopes, one, np.zeros((2, 3)))
    own, others = known.first_states(np.zeros(1), 0.7, None, 0.25), known.first_of_others(4, 0.25)
    # each window's second direction has 0.3 and 0.1: less than a quarter of the record in the mean
    assert own.shape.shape == (2, 3, 1)
    assert (own.shape[..., 0] != 0.0).tolist() == [[True, False, False], [False, True, False]]
    assert others.mean.shape == (4, 3) and others.shape.shape == (4, 3, 2), "1.55, 1.65 and 0.075 in the mean"
    np.testing.assert_allclose(others.shape[3] @ others.shape[0].T, np.diag([1.0, 1.0, 0.0]), atol=1e-12)


def test_the_mean_of_the_samples_takes_their_common_bend_out(cost: MatchingCost) -> None:
    first = FirstStates.recorded(len(cost.clips.windows), cost.nx)
    middle, mean = about(cost, first), about(cost, first, mean=True)
    lift = mean.residual - middle.residual
    np.testing.assert_allclose(mean.bend, middle.bend - lift**2)
    np.testing.assert_allclose(lift, to_host(middle.curves).mean(axis=0), atol=1e-9)
    assert (mean.bend > -1e-12).all()


def test_samples_that_a_bound_cuts_short_move_no_mean(cost: MatchingCost) -> None:
    """Pairs are lopsided there: that is slope, not bend."""
    nothing, (_, upper) = FirstStates.recorded(len(cost.clips.windows), 0), cost.system.space.bounds
    inside, at_bound = (cost.system.space.z_of(TRUTH) for _ in range(2))
    inside[0], at_bound[0] = upper[0] - 0.2, upper[0]
    free, cut = (np.abs(about(cost, nothing, z).lift).max() for z in (inside, at_bound))
    assert cut < 2.0 * free


@pytest.mark.parametrize("size", [0.0, 0.3, 3.0])
def test_what_jitter_makes_of_slopes_is_no_information(size: float) -> None:
    """Of slopes that err by jitter, what is left tells as much as the true ones; of jitter alone, nothing."""
    rng = np.random.default_rng(0)
    clips, d, nx, residuals, pairs = 12, 3, 2, 400, 8
    true = size * rng.standard_normal((clips, d + nx, residuals))
    true[:, 0] = 0.0
    jitter = rng.uniform(1.0, 4.0, (clips, residuals))
    noisy = true + rng.standard_normal(true.shape) * np.sqrt(jitter / pairs)[:, None]
    freed = without_jitter(noisy, jitter * (pairs - 1) / pairs, pairs, d)
    for own in (slice(0, d), slice(d, None)):  # of the parameters, and of first states
        told = [
            np.einsum("cir,cr,cjr->ij", slopes[:, own], 1.0 / (1.0 + jitter), slopes[:, own])
            for slopes in (true, noisy, freed)
        ]
        spurious = np.trace(told[1] - told[0]) / len(told[0])
        assert np.abs(told[2] - told[0]).max() < 0.2 * spurious + 0.1 * np.abs(told[0]).max()


def test_clips_that_take_turns_are_freed_of_jitter_together(
    cost: MatchingCost, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = FirstStates.recorded(len(cost.clips.windows), cost.nx)
    together = about(cost, first, mean=True)
    monkeypatch.setattr("amhe_cli.estimation.core.linearise.TURN_BYTES", 1000)
    in_turns = about(cost, first, mean=True)
    np.testing.assert_array_equal(in_turns.gain, together.gain)
    assert (about(cost, first).gain != together.gain).any()


def made(clips: int = 3, nuisances: int = 2, seed: int = 0) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    shapes = ((clips, 40), (clips, 3, 40), (clips, nuisances, 40), (clips, 40), (clips, nuisances))
    residual, gz, gx, weight, mean = (rng.standard_normal(shape) for shape in shapes)
    return residual, gz, gx, np.exp(weight), mean


def test_marginalising_equals_the_schur_complement_of_the_joint_problem() -> None:
    residual, gz, gx, weight, mean = made()
    found = marginalised(residual, gz, gx, weight, mean)
    for c in range(3):
        both, w = np.concatenate((gz[c], gx[c])), np.diag(weight[c])
        joint = both @ w @ both.T + np.diag([0.0] * 3 + [1.0] * 2)
        score = both @ w @ residual[c] + np.concatenate((np.zeros(3), mean[c]))
        covariance = np.linalg.inv(joint)
        np.testing.assert_allclose(np.linalg.inv(found.matrix[c]), covariance[:3, :3], rtol=1e-9)
        step = -covariance @ score
        alone, _ = gauss_newton_step(found.matrix[c], found.score[c], np.zeros((3, 3)), np.zeros(3))
        np.testing.assert_allclose(alone, step[:3], rtol=1e-8)
        nuisance = found.nuisance[c] + found.nuisance_gain[c] @ alone
        np.testing.assert_allclose(nuisance, mean[c] + step[3:], rtol=1e-8)
        left = residual[c] + step @ both
        slope = gz[c] + found.nuisance_gain[c].T @ gx[c]  # the nuisances moved along
        np.testing.assert_allclose(found.residual[c] + alone @ slope, left, atol=1e-9)


def test_without_nuisances_the_information_is_that_of_least_squares() -> None:
    residual, gz, _, weight, _ = made(nuisances=0)
    found = marginalised(residual, gz, np.zeros((3, 0, 40)), weight, np.zeros((3, 0)))
    np.testing.assert_allclose(found.matrix, np.einsum("cir,cr,cjr->cij", gz, weight, gz))
    np.testing.assert_allclose(found.score, np.einsum("cir,cr,cr->ci", gz, weight, residual))
    np.testing.assert_array_equal(found.residual, residual)


def test_a_clip_of_weight_zero_has_no_information() -> None:
    residual, gz, gx, weight, mean = made()
    weight[1] = 0.0
    found = marginalised(residual, gz, gx, weight, mean)
    assert not found.matrix[1].any() and not found.score[1].any()


def test_a_prior_pulls_the_step_towards_its_mean() -> None:
    step, hessian = gauss_newton_step(
        np.diag([3.0, 0.0]), np.array([6.0, 0.0]), np.eye(2), np.array([2.0, 5.0])
    )
    assert step == pytest.approx([-2.0, -5.0])
    np.testing.assert_array_equal(hessian, np.diag([4.0, 1.0]))


def cost_of(clips: int, samples: int, widths: dict[str, int], trim: float = 0.0) -> Any:
    """A cost with channels of these widths, half of whose samples were measured in the first clip."""
    mask = np.ones((clips, samples), dtype=bool)
    mask[0, samples // 2 :] = False
    observed = [
        SimpleNamespace(channel=SimpleNamespace(key=key), width=width, mask=mask)
        for key, width in widths.items()
    ]
    counts = mask.sum(axis=1) * sum(widths.values())
    settings = SimpleNamespace(trim=trim, huber=3.0)
    return SimpleNamespace(clips=SimpleNamespace(observed=observed, counts=counts), settings=settings)


def noisy(cost: Any, sd: dict[str, float], seed: int = 0) -> np.ndarray:
    """Residuals with this noise, zero where nothing was measured, shape (c, R)."""
    rng, parts = np.random.default_rng(seed), []
    for observed in cost.clips.observed:
        shape = (*observed.mask.shape, observed.width)
        values = sd[observed.channel.key] * rng.standard_normal(shape) * observed.mask[..., None]
        parts.append(values.reshape(len(values), -1))
    return np.concatenate(parts, axis=1)


def fitted(residual: np.ndarray, nuisance: np.ndarray) -> Information:
    clips = len(residual)
    found = marginalised(
        residual, np.zeros((clips, 1, residual.shape[1])), np.zeros((clips, 0, residual.shape[1])),
        np.ones_like(residual), np.zeros((clips, 0)),
    )  # fmt: skip
    kept = {name: getattr(found, name) for name in Information.__slots__}
    return Information(**{**kept, "nuisance": nuisance})


def test_the_noise_scale_is_the_residual_sd_over_the_declared_one() -> None:
    cost = cost_of(6, 400, {"box.position": 3, "joints.position": 1})
    residual = noisy(cost, {"box.position": 2.0, "joints.position": 0.5})
    squares = mean_squares(cost, residual, np.ones(6, dtype=bool))
    scale = noise_scale(squares, {"box.position": 3.0})
    assert scale == pytest.approx({"box.position": 6.0, "joints.position": 0.5}, rel=0.05)


def test_residuals_below_a_thousandth_of_the_noise_are_rounding_and_no_noise() -> None:
    assert noise_scale({"joints.position": 1e-20}, {"joints.position": 0.1}) == {"joints.position": 1e-3}


def test_clips_that_diverged_or_are_the_worst_do_not_count_for_the_noise() -> None:
    cost = cost_of(10, 400, {"box.position": 3}, trim=0.1)
    residual = noisy(cost, {"box.position": 1.0})
    residual[4], residual[7] = 1e6, 30.0
    completed = np.ones(10, dtype=bool)
    completed[4] = False
    slopes: Any = SimpleNamespace(cost=cost, completed=completed)
    found = fitted(residual, np.zeros((10, 0)))
    weight = clip_weights(slopes, found)
    assert np.flatnonzero(weight == 0.0).tolist() == [4], "the trimmed one is the one that diverged"
    cost.settings.trim = 0.2
    assert np.flatnonzero(clip_weights(slopes, found) == 0.0).tolist() == [4, 7]
    assert fitted_noise_scale(slopes, found, {})["box.position"] == pytest.approx(1.0, rel=0.05)


def test_what_fitting_first_states_took_from_the_residuals_is_added_again() -> None:
    cost = cost_of(4, 50, {"box.position": 2})
    slopes: Any = SimpleNamespace(cost=cost, completed=np.ones(4, dtype=bool))
    residual, nuisance = noisy(cost, {"box.position": 1.0}), np.full((4, 6), 2.0)
    plain = fitted_noise_scale(slopes, fitted(residual, np.zeros((4, 6))), {})["box.position"]
    scale = fitted_noise_scale(slopes, fitted(residual, nuisance), {})["box.position"]
    assert scale**2 - plain**2 == pytest.approx(4 * 6 * 4.0 / cost.clips.counts.sum())


def test_weights_fall_with_outliers_noise_and_autocorrelation() -> None:
    cost = cost_of(2, 10, {"a": 1, "b": 1})
    residual = np.zeros((2, 20))
    plain = weights(cost, residual, (1.0, 4.0))
    np.testing.assert_allclose(plain, np.tile([1.0] * 10 + [0.25] * 10, (2, 1)))
    np.testing.assert_allclose(weights(cost, residual, (1.0, 4.0), (9.0, 1.0))[:, :10], 1.0 / 9.0)
    residual[1, 3] = 300.0
    assert weights(cost, residual, (1.0, 1.0))[1, 3] == pytest.approx(0.01, rel=1e-3)


@pytest.mark.parametrize(("size", "lasts", "most"), [(1.0, 1, 1.0), (1.0, 25, 1.6), (0.5, 25, 1.3)])
def test_a_score_scatters_as_over_runs_whether_or_not_their_jitter_lasts(
    cost: MatchingCost, size: float, lasts: int, most: float
) -> None:
    """Jitter counts by what it does to the score, also where a few pairs show it; never too little.

    Too much where the autocorrelation times of a single run, which err, leave open whether noise lasts, too.
    """
    rng, slopes = np.random.default_rng(0), about(cost, FirstStates.recorded(len(cost.clips.windows), 0))
    white = rng.standard_normal((400, *slopes.bend.shape))
    jitter = size / np.sqrt(lasts) * np.apply_along_axis(np.convolve, 2, white, np.ones(lasts), "same")
    runs, means = jitter + rng.standard_normal(jitter.shape), 0.5 * (jitter[::2] + jitter[1::2])
    ratios = []
    for k in range(12):
        few = means[16 * k : 16 * k + 16].copy()
        few[3] = 0.0  # it diverged
        residual = runs[(32 * k + 200) % 400] - few.sum(axis=0) / 15.0
        jagged = replace(slopes, curves=few, bend=few.var(axis=0), pairs=np.ones((16, 4)), averaged=True)
        kept, left = (information(replace(jagged, residual=residual, averaged=own)) for own in (True, False))
        scores = np.einsum("cdr,hcr->hcd", _pull(jagged, kept), runs)
        ratios.append(
            [np.trace(one.scatter.sum(axis=0)) / (scores**2).sum() * len(runs) for one in (kept, left)]
        )
    kept, left = np.mean(ratios, axis=0)
    if lasts == 1:
        assert kept == pytest.approx(left, rel=0.1), "white jitter stands in the residuals already"
    else:
        assert 0.9 < kept < most
        assert (left < 0.7) == (size < 1.0), "small jitter that lasts does not show in the residuals"
