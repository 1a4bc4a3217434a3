"""The rollout-matching cost: the one place where predictions meet measurements.

    J(theta) = trimmed mean over clips of (1 / count) sum over steps, channels of rho(|| r ||^2)
    r = (predicted - measured) / noise sd;  rotations: log(measured^-1 predicted) / noise sd

These are the paper's equations (1) and (5) without their priors, made robust (rho is the pseudo-Huber loss),
and normalised by count so that costs compare across clip lengths. Identification, moving-horizon
estimation and the design of probes all use it.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import (
    AnyArray,
    BoolArray,
    FloatArray,
    IntArray,
    namespace_of,
    side_by_side,
    to_host,
)
from amhe_cli.core.each_log import same_values, values_on
from amhe_cli.core.log import Log, Window
from amhe_cli.core.settings import CostSettings
from amhe_cli.core.statistics import pseudo_huber, trimmed_mean
from amhe_cli.engine.rollout import Engine, Predicted, Rollouts, Starts, Wanted
from amhe_cli.matching.readings import averaged, reading_of, state_errors
from amhe_cli.matching.windows import Clips, Observed, prepare
from amhe_cli.system.description.data import Channel
from amhe_cli.system.system import System


@dataclass(frozen=True, eq=False)
class Residuals:
    """Whitened residuals of p candidates on c clips.

    Args:
        values: One array for each channel, shape (p, c, samples, k), numpy's or on the engine's device;
            zero where nothing was measured.
        completed: False where a rollout diverged, shape (p, c); a numpy array.
    """

    values: tuple[AnyArray, ...]
    completed: BoolArray

    @cached_property
    def stacked(self) -> AnyArray:
        """All channels side by side, shape (p, c, R), where the values lie."""
        p, c = self.completed.shape
        stack = namespace_of(self.values[0]).concatenate
        return stack([v.reshape(p, c, -1) for v in self.values], axis=-1)

    @property
    def flat(self) -> FloatArray:
        """All channels side by side, shape (p, c, R), as a numpy array."""
        return to_host(self.stacked)


@dataclass(frozen=True, slots=True, eq=False)
class RolledOut:
    """Rollouts of some clips under one theta (d,), with their inputs (c, H, nu) and lengths (c,)."""

    theta: FloatArray
    inputs: FloatArray
    lengths: IntArray
    rollouts: Rollouts


class MatchingCost:
    """How well candidate parameters explain a fixed set of clips.

    Args:
        system: What to compare, and how.
        windows: The clips; every candidate is rolled out on all of them.
        engine: The rollout engine.
        settings: Settings of the robust loss and of trimming.
        noise_scale: Channel -> factor on its declared noise sd, where the data showed another.
    """

    def __init__(
        self,
        system: System,
        windows: Sequence[Window],
        engine: Engine,
        settings: CostSettings,
        noise_scale: Mapping[str, float] | None = None,
    ) -> None:
        self.system, self.engine, self.settings = system, engine, settings
        self.noise_scale = noise_scale or {}
        self.times: Mapping[str, float] | None = None  # those that residuals show
        self.clips: Clips = prepare(system, windows, self.noise_scale, settings.smoothing)
        self._alike = _alike([window.log for window in windows])
        self._wanted = [observed.wanted for observed in self.clips.observed]

    def scaled(self, noise_scale: Mapping[str, float]) -> MatchingCost:
        """The same clips, where the data showed another noise than the declared one."""
        other, before = copy.copy(self), self.noise_scale
        ratios = [
            noise_scale.get(o.channel.key, 1.0) / before.get(o.channel.key, 1.0) for o in self.clips.observed
        ]
        observed = (replace(o, noise=r * o.noise) for o, r in zip(self.clips.observed, ratios, strict=True))
        other.noise_scale, other.clips = noise_scale, replace(self.clips, observed=tuple(observed))
        return other

    def under(self, noise_scale: Mapping[str, float], times: Mapping[str, float]) -> MatchingCost:
        """The same clips under some noise, whatever residuals show; `times`: its autocorrelation times."""
        other = self.scaled(noise_scale)
        other.times = times
        return other

    def upon(self, engine: Engine, system: System | None = None) -> MatchingCost:
        """The same clips rolled out by another engine.

        Args:
            system: The system with further parameters, for an engine that knows them; None: as before.
        """
        other = copy.copy(self)
        other.engine, other.system = engine, system or self.system
        return other

    def at_half_steps(self, engine: Engine) -> MatchingCost:
        """The same clips rolled out by an engine on a model of half the time step."""
        other = self.upon(engine)
        other.clips = replace(self.clips, starts=self.clips.starts.at_half_steps())
        other._wanted = [wanted.at_half_steps() for wanted in self._wanted]
        return other

    def of(self, clips: IntArray) -> MatchingCost:
        """The cost on some of the clips."""
        other = copy.copy(self)
        other.clips = self.clips.of(clips)
        other._alike = _alike([window.log for window in other.clips.windows])
        other._wanted = [wanted.of(clips) for wanted in self._wanted]
        return other

    @property
    def nx(self) -> int:
        """Number of first-state coordinates whose measurement error is known."""
        return self.clips.starts.first_index.size

    def predict(self, z: FloatArray, first: FloatArray | None = None) -> Predicted:
        """Predictions of the compared channels at the times at which they measured.

        Args:
            z: Candidates, shape (p, d).
            first: First-state errors in units of their sd, shape (p, c, nx); None starts every clip
                from its recorded state.

        Returns:
            One array for each channel, shape (p, c, samples, columns), and the completed mask (p, c).
        """
        theta = self.system.space.theta_of(self.system.space.clip(z))
        parts = []
        for log, clips in self._alike:
            values = values_on(log, self.system.edits.space, self.system.space, theta)
            if len(self._alike) == 1:
                return self._shown(values, self.clips.starts, first, self._wanted)
            own_first = None if first is None else first[:, clips]
            own_wanted = [wanted.of(clips) for wanted in self._wanted]
            parts.append(self._shown(values, self.clips.starts.of(clips), own_first, own_wanted))
        return _in_order(parts, np.argsort(np.concatenate([clips for _, clips in self._alike])))

    def rolled_out(self, z: FloatArray, first: FloatArray | None) -> Iterator[RolledOut]:
        """Whole rollouts of one candidate, those together on which the parameters have the same values.

        Args:
            z: The candidate, shape (d,).
            first: First-state errors in units of their sd, shape (c, nx); None: none.
        """
        system = self.system
        theta = system.space.theta_of(system.space.clip(z))[None]
        for log, clips in self._alike:
            values = values_on(log, system.edits.space, system.space, theta)
            starts = self.clips.starts.of(clips)
            first_errors = None if first is None else first[None, clips]
            if (errors := state_errors(system, values, starts)) is not None:
                first_errors = errors if first_errors is None else first_errors + errors
            qpos, qvel = starts.states(system.model, 1, first_errors)
            inputs = starts.inputs_under(system.edits.delays(values) / system.dt)
            every = np.repeat(values, len(clips), axis=0)
            rollouts = self.engine.rollout(every, qpos[0], qvel[0], inputs, starts.lengths)
            yield RolledOut(values[0], inputs, starts.lengths, rollouts)

    def _shown(
        self, theta: FloatArray, starts: Starts, first: FloatArray | None, wanted: Sequence[Wanted]
    ) -> Predicted:
        """Predict what the log's sensors show."""
        if (errors := state_errors(self.system, theta, starts)) is not None:
            first = errors if first is None else first + errors
        return self._read(theta, self.engine.predict(theta, starts, first, wanted))

    def _read(self, theta: FloatArray, predicted: Predicted) -> Predicted:
        """Sensor readings of the model's values."""
        calibration = self.system.calibration
        if not calibration.readings:
            return predicted
        numbers, values = self.system.edits.numbers(theta), []
        for observed, true in zip(self.clips.observed, predicted.values, strict=True):
            reading = calibration.readings.get(observed.channel.series)
            reading = None if reading is None else reading.of(observed.channel.part)
            if reading is not None and reading.band is not None:
                apart = true.reshape(*true.shape[:2], -1, observed.memory, true.shape[-1])
                true = averaged(reading, numbers, self.system.dt, apart)
            values.append(reading_of(observed.channel, reading, numbers, true))
        return Predicted(tuple(values), predicted.completed)

    def residuals(self, z: FloatArray, first: FloatArray | None = None) -> Residuals:
        """Whitened residuals of candidates z (p, d); see `predict` for `first`."""
        return self._residuals(self.predict(z, first))

    def residuals_of(self, rolled: RolledOut) -> Residuals:
        """Whitened residuals of one candidate whose rollouts on all of the clips are known."""
        values = tuple(wanted.pick(rolled.rollouts, 1) for wanted in self._wanted)
        return self._residuals(
            self._read(rolled.theta[None], Predicted(values, rolled.rollouts.completed[None]))
        )

    def _residuals(self, predicted: Predicted) -> Residuals:
        pairs = zip(self.clips.observed, predicted.values, strict=True)
        return Residuals(tuple(whitened(observed, values) for observed, values in pairs), predicted.completed)

    def losses(self, residuals: Residuals) -> list[FloatArray]:
        """Robust loss of each channel, summed over its samples, shape (p, c) each; as numpy arrays."""
        losses = []
        for values in residuals.values:
            squared = namespace_of(values).einsum("pcsk,pcsk->pcs", values, values)
            losses.append(to_host(pseudo_huber(squared, self.settings.huber).sum(axis=-1)))
        return losses

    def clip_costs(self, residuals: Residuals) -> FloatArray:
        """Cost of every candidate on every clip, shape (p, c); inf where the rollout diverged."""
        total = sum(self.losses(residuals))
        return np.where(residuals.completed, total / self.clips.counts, np.inf)

    def costs(self, z: FloatArray, first: FloatArray | None = None) -> FloatArray:
        """Cost of candidates z (p, d), shape (p,); inf where any clip diverged."""
        return self.costs_of(self.residuals(z, first))

    def costs_of(self, residuals: Residuals) -> FloatArray:
        """Costs (p,) of the candidates with these residuals; inf where any clip diverged."""
        cost = trimmed_mean(self.clip_costs(residuals), self.settings.trim)
        return np.where(residuals.completed.all(axis=1), cost, np.inf)

    def as_declared(self, residuals: Residuals) -> FloatArray:
        """Costs (p,) of residuals in units of the declared noise, whatever the data have shown."""
        factors = (self.noise_scale.get(observed.channel.key, 1.0) for observed in self.clips.observed)
        values = tuple(factor * residual for factor, residual in zip(factors, residuals.values, strict=True))
        return trimmed_mean(self.clip_costs(Residuals(values, residuals.completed)), self.settings.trim)

    def errors(self, residuals: Residuals, quantity: str) -> FloatArray:
        """Distance [m] or angle [rad] between prediction and measurement, mean over time; (p, clips).

        Args:
            residuals: Residuals of p candidates.
            quantity: 'position' or 'orientation' of bodies; NaN where the system measures none.
        """
        total = np.zeros(residuals.completed.shape)
        count = np.zeros(len(self.clips.windows))
        for observed, values in zip(self.clips.observed, residuals.values, strict=True):
            if measures(observed.channel, quantity):
                distance = namespace_of(values).linalg.norm(values, axis=-1)
                total += observed.noise * to_host(distance.sum(axis=-1))
                count += observed.mask.sum(axis=-1)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(residuals.completed, total / count, np.inf)


def _alike(logs: Sequence[Log]) -> list[tuple[Log, IntArray]]:
    """The clips by their logs, those together on which the parameters have the same values."""
    groups: dict[object, list[int]] = {}
    for i, log in enumerate(logs):
        groups.setdefault(same_values(log), []).append(i)
    return [(logs[clips[0]], np.array(clips)) for clips in groups.values()]


def _in_order(parts: Sequence[Predicted], order: IntArray) -> Predicted:
    """Predictions of some clips each as one of all clips, in their order."""
    columns = zip(*(part.values for part in parts), strict=True)
    beside = map(side_by_side, columns)
    values = tuple(namespace_of(arrays[0]).concatenate(arrays, axis=1)[:, order] for arrays in beside)
    return Predicted(values, np.concatenate([part.completed for part in parts], axis=1)[:, order])


def measures(channel: Channel, quantity: str) -> bool:
    """Whether a channel measures a body's 'position' or 'orientation'."""
    if quantity == "orientation":
        return channel.kind == "rotation"
    return channel.unit == "m" and len(channel.columns) == 3


def whitened(observed: Observed, predicted: AnyArray) -> AnyArray:
    """Residuals of one channel in units of its noise sd, computed where the prediction lies.

    Args:
        observed: What the channel measured on c clips.
        predicted: What p candidates predict, shape (p, c, samples, columns).

    Returns:
        Residuals, shape (p, c, samples, k); 0 where nothing was measured.
    """
    xp = namespace_of(predicted)
    measured, scale = xp.asarray(observed.measured), xp.asarray(observed.mask[..., None] / observed.noise)
    if observed.channel.kind == "rotation":
        return rotations.difference(predicted, xp.broadcast_to(measured, predicted.shape)) * scale
    return (predicted - measured) * scale


def quadratic_prior(z: FloatArray, mean: FloatArray, precision: FloatArray) -> FloatArray:
    """Arrival cost (z - mean)' P (z - mean) of candidates z (p, d), the last term of (5); shape (p,)."""
    away = z - mean
    return np.einsum("pi,ij,pj->p", away, precision, away)
