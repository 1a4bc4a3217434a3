"""Result of an identification: plain values for the table, the files and the report."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.belief import Belief
from amhe_cli.system.parameters.inertia import inertia_of

#: Verdicts, best first, and what each means to the user.
VERDICTS: Mapping[str, str] = {
    "identified": "the logs determine the value",
    "conditional": "the logs determine it, if the number that is named is right",
    "weak": "the logs narrow it down: use the interval, not the estimate alone",
    "prior": "the logs hardly narrow it down: the value is your prior",
    "model-sensitive": "the value depends on details that the model gets wrong",
}


@dataclass(frozen=True, slots=True)
class Reason:
    """Why a verdict is what it is.

    Args:
        kind: A kind of terms of the ledger ('noise', 'prior', 'repeats', 'parts', 'assumed', 'curvature',
            'search', 'minimum', 'spread', 'declared'), or 'idle', 'bound', 'misfit', 'open', 'together'.
        parameters: The parameters that it is about.
        size: Share of the variance that it holds; of 'open' the distance from the prior in its sd, of
            'together' the correlation, else 1.
        text: The reason in words.
    """

    kind: str
    parameters: tuple[str, ...]
    size: float
    text: str

    def __str__(self) -> str:
        return self.text


@dataclass(frozen=True, slots=True, eq=False)
class ParameterResult:
    """One parameter's line of the report; everything in the parameter's own unit.

    Args:
        sd: Posterior standard deviation (on the log scale times the estimate, where log-scaled).
        prior_sd: Standard deviation of the prior, on the log scale times the prior's value.
        lower, upper: 90 % interval.
        bounds: The hard bounds of the search.
        shrinkage: 1 - posterior sd / prior sd, on the parameter's own scale.
        verdict: A key of VERDICTS.
        reasons: Why the verdict is what it is, most important first.
        budget: Share of the variance by kind of term (`estimation/uncertainty/ledger.py`); their sum is 1.
        doubled_prior: How far the estimate would move if the sd of its prior were twice as large.
        given: Of 'conditional', the number that it rests on most, such as 'the gain of servo, 4'.
    """

    name: str
    unit: str
    estimate: float
    prior: float
    prior_sd: float
    sd: float
    lower: float
    upper: float
    bounds: tuple[float, float]
    shrinkage: float
    verdict: str
    reasons: tuple[Reason, ...]
    budget: Mapping[str, float] = field(default_factory=dict)
    doubled_prior: float = math.nan
    given: str = ""

    def __repr__(self) -> str:
        told = f"{self.name} {self.estimate:.4g} ± {self.sd:.2g} {self.unit}".removesuffix(" -")
        return f"<{told}, 90 % {self.lower:.4g} to {self.upper:.4g}: {self.verdict}>"

    @property
    def interval(self) -> tuple[float, float]:
        """90 % interval."""
        return self.lower, self.upper


@dataclass(frozen=True, slots=True)
class Combination:
    """A product of parameters and how well it is known, such as 'box_mass * friction: 1.2 %'.

    Args:
        text: The product.
        sd: Sd of its logarithm: 0.01 is 1 %.
        shrinkage: 1 - posterior sd / prior sd.
        names: The parameters.
    """

    text: str
    sd: float
    shrinkage: float
    names: tuple[str, ...]


def sharper(combinations: Sequence[Combination], relative: Mapping[str, float]) -> list[Combination]:
    """Combinations known more precisely than each of their parameters, by the relative sd; best first."""
    better = (c for c in combinations if c.sd < min(relative.get(name, math.inf) for name in c.names))
    return sorted(better, key=lambda c: c.sd)


@dataclass(frozen=True, slots=True)
class OwnSpread:
    """How far the logs' own values of a parameter lie from their common mean.

    Args:
        name: The parameter; its line is the common mean.
        values: Names of the lines with the values.
        estimate, lower, upper: Median and 90 % interval of their standard deviation.
        log: Whether that is of the logarithm (0.1 is 10 %) or in the parameter's unit.
    """

    name: str
    values: tuple[str, ...]
    estimate: float
    lower: float
    upper: float
    log: bool


@dataclass(frozen=True, slots=True)
class SpanError:
    """Mean error of one channel over a span of time of the held-out clips, before and after identification.

    Of a pose it is a distance or an angle, of several joints or others the mean over them.

    Args:
        channel: Name of the channel, such as 'joints.position'.
        unit: Unit of the errors.
        start, end: The span, from the clips' start [s].
        initial, identified: From the recorded first states.
        initial_fitted, identified_fitted: With the first states fitted; NaN: not computed.
    """

    channel: str
    unit: str
    start: float
    end: float
    initial: float
    identified: float
    initial_fitted: float = math.nan
    identified_fitted: float = math.nan


@dataclass(frozen=True, slots=True)
class HorizonError:
    """Rms error of one joint, or of a pose, at a time after the start of predictions of held-out logs.

    Args:
        channel: Name of the channel, such as 'joints.position'.
        column: The joint; '' for a pose.
        unit: Unit of the errors.
        horizon: The time [s]; the longest where the predictions go on to the logs' end.
        to_end: They do.
        clips: Number of predictions.
        moved: Rms distance that was measured between start and horizon; NaN of an orientation.
        initial, identified: The error before and after identification; infinite where a prediction diverged.
    """

    channel: str
    column: str
    unit: str
    horizon: float
    to_end: bool
    clips: int
    moved: float
    initial: float
    identified: float


@dataclass(frozen=True, slots=True)
class Against:
    """What speaks against every value.

    Args:
        kind: 'misfit': the model misses what was fitted. 'left out': clips that were left out contradict the
            others. 'worse': held-out clips fit worse than before. 'held out': they are missed more than
            fitted ones. 'short': the search was cut short.
        text: It in words.
    """

    kind: Literal["misfit", "left out", "worse", "held out", "short"]
    text: str


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Costs and errors on clips that were not fitted, after and before identification.

    Clips start from their recorded first states, whose noise is a floor under costs and errors; where a name
    says `fitted`, from first states that were fitted to them, as those of fitted clips are.
    Errors are means over time and clips; NaN where the system measures no such quantity.

    Args:
        fitted_cost, initial_fitted_cost: NaN: not computed.
        noise_scale: Channel -> residual sd over declared noise sd, first states fitted.
        misses: Channel -> how many times as much it is missed as in fitted clips, where that is not chance.
        errors: Each channel's error over all of the clips, then over spans of time.
        horizons: Error of each joint and pose against the horizon.
    """

    clips: int
    cost: float
    initial_cost: float
    position_error_m: float
    initial_position_error_m: float
    orientation_error_rad: float
    initial_orientation_error_rad: float
    fitted_cost: float = math.nan
    initial_fitted_cost: float = math.nan
    noise_scale: Mapping[str, float] = field(default_factory=dict)
    misses: Mapping[str, float] = field(default_factory=dict)
    errors: tuple[SpanError, ...] = ()
    horizons: tuple[HorizonError, ...] = ()


@dataclass(frozen=True, slots=True)
class Iteration:
    """One line of the convergence record."""

    number: int
    method: str
    cost: float  # best of the iteration
    sigma: float  # mean sampling sd, in prior sd
    rollouts: int
    diverged: int
    theta: tuple[float, ...]  # of what was searched: with values of logs' own, not of their means
    stage: str = ""  # 'explore' or 'polish' of the linearised search; 'conclusion' of a part of that

    def summary(self, total: int) -> str:
        """Progress in words: 'fitting, 5 of about 16: cost 1.04', or 'checking, 14 of 15: ...'."""
        if self.stage != "conclusion":
            return f"fitting, {self.number} of about {total}: cost {self.cost:.4g}"
        part = {"search for a second minimum": "is there a second solution?"}.get(self.method, self.method)
        return f"checking, {self.number} of {total}: {part}"


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Measured against predicted for one channel of one clip, for the figures.

    Args:
        clip: Label, such as 'toss_041.mcap 0.00-0.40 s'.
        channel: Name of the channel, such as 'cube.position'.
        units: Unit of all columns, or of each.
        columns: Names of the columns, length k.
        time: Times of the measurements, from the clip's start [s], shape (T,).
        measured, initial, identified: Values, shape (T, k); for rotations, rotation vectors relative
            to the clip's first measured orientation.
        noise: Noise sd of one column.
        held_out: The clip was not fitted.
        inputs: Name, unit and values then (T,) of each input; unit '': it has none.
    """

    clip: str
    channel: str
    units: tuple[str, ...]
    columns: tuple[str, ...]
    time: FloatArray
    measured: FloatArray
    initial: FloatArray
    identified: FloatArray
    noise: float
    held_out: bool
    inputs: tuple[tuple[str, str, FloatArray], ...] = ()


@dataclass(frozen=True, slots=True)
class ClipCount:
    """How many clips were used and why others were not; of long logs some stand for all (`thinned`).

    `refitted`: the logs are short, so the held-out clips judged a first fit, and the values fit them too.
    """

    fitted: int
    held_out: int
    motionless: int
    across_gaps: int
    thinned: int = 0
    refitted: bool = False

    @property
    def fitted_of(self) -> str:
        """How many clips were fitted, in words: '24 clips', '144 of 1174 clips'."""
        count = self.fitted + self.thinned
        return f"{f'{self.fitted} of ' * (self.thinned > 0)}{count} clip{'s' * (count != 1)}"


@dataclass(frozen=True, slots=True)
class RunEstimate:
    """Estimate from one log alone.

    Args:
        log: Name of the log.
        values: Estimate and sd, in the parameter's unit, of each parameter that it says anything of.
    """

    log: str
    values: Mapping[str, tuple[float, float]]


@dataclass(frozen=True, slots=True, eq=False)
class MissingRow:
    """One cause of what a model does not explain.

    Args:
        kind, place: What is missing, and where.
        text: It in words.
        share: Share of the unexplained force there that it explains on data that were not fitted.
        rivals: Other causes that explain as much, in words.
        repair: Entries of `parameters` in `system.yaml` that let the model have it; {}: none does.
        against: What the picture shows: name, values (n,), unexplained force (n,), and the cause's (n,).
    """

    kind: str
    place: str
    text: str
    share: float
    rivals: tuple[str, ...] = ()
    repair: Mapping[str, Any] = field(default_factory=dict)
    against: tuple[str, FloatArray, FloatArray, FloatArray] | None = None

    @property
    def name(self) -> str:
        """What `--repair` calls it: 'load-friction@hip'."""
        return f"{self.kind.replace(' ', '-')}@{self.place}"

    @property
    def in_log(self) -> bool:
        """The log is wrong, not the model: its force has no picture."""
        return self.against is None


@dataclass(frozen=True, slots=True, eq=False)
class Missing:
    """What explains the motion that a model does not, most first.

    Args:
        rows: The causes.
        chance: Share that chance would explain.
        tested: Number of candidates.
        start, left: What the model, and what it and the rows leave of the accelerations, as a share.
        untested: Why nothing could be tested; '': it was.
        looked: Share of the motion that was looked at: where nothing touches.
    """

    rows: tuple[MissingRow, ...] = ()
    chance: float = 0.0
    tested: int = 0
    start: float = 0.0
    left: float = 0.0
    untested: str = ""
    looked: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class AtHorizon:
    """Errors of m systems at one horizon, on the same c clips.

    Args:
        horizon: The horizon [s]; the longest where predictions go on to the logs' end.
        to_end: They do.
        clips: Number of clips, c.
        errors: Joint, or pose, with its unit -> rms error of each system over the clips, shape (m,).
        ratios: Error of system i over that of j, all joints in units of their usual error, shape (m, m).
        lower, upper: 95 % interval of the ratios; NaN where there are too few clips.
    """

    horizon: float
    to_end: bool
    clips: int
    errors: Mapping[tuple[str, str], FloatArray]
    ratios: FloatArray
    lower: FloatArray
    upper: FloatArray

    def better(self, one: int, other: int) -> bool:
        """Whether a system's error is smaller than another's, by more than chance."""
        return bool(self.upper[one, other] < 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class Repair:
    """A model that was given what it lacks, against the model before it.

    Args:
        name: Kind and place of the cause, such as 'spring@arm'; 'without spring@arm' where one is left out.
        text: The cause in words.
        parameters: Entries of `parameters` in `system.yaml` that it adds.
        kept: It predicts held-out clips better, by more than chance; of one that is left out: no worse.
        verdict: What the held-out clips say of it, or why it was not tried, in words.
        horizons: Errors of the model before it, and of it; empty where it was not tried.
    """

    name: str
    text: str
    parameters: Mapping[str, Any]
    kept: bool
    verdict: str
    horizons: tuple[AtHorizon, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Identification:
    """The result of `amhe identify`."""

    system: str
    method: str
    parameters: tuple[ParameterResult, ...]
    belief: Belief
    correlations: FloatArray  # (d, d)
    combinations: tuple[Combination, ...]
    held_out: HeldOut | None
    iterations: tuple[Iteration, ...]
    rollouts: int
    diverged: int
    clips: ClipCount
    noise_scale: Mapping[str, float]  # channel -> residual sd over declared noise sd
    fits: tuple[Fit, ...]
    unexplained: tuple[Against, ...] = ()  # why no value can be believed
    exact: tuple[str, ...] = ()  # settings of numbers of the model that act and are taken as exact
    interrupted: bool = False
    settled: bool = True  # False: it was still moving, or Ctrl-C or the time limit ended it
    logs: tuple[str, ...] = field(default=())
    spreads: tuple[OwnSpread, ...] = ()
    bodies: tuple[ParameterResult, ...] = ()  # mass, centre and moments, in place of their coordinates
    runs: tuple[RunEstimate, ...] = ()
    missing: Missing | None = None  # None: the model misses the logs by no more than twice their noise
    information: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))  # of the logs about z, (d, d)
    validated: Belief | None = None  # with the values that held-out clips judge
    unbounded: FloatArray = field(default_factory=lambda: np.zeros(0))  # z where no bound holds it, (d,)
    determined: tuple[str, ...] = ()  # what matched efforts tell: of all, and of each joint
    repairs: tuple[Repair, ...] = ()  # in the order in which they were tried

    @property
    def lines(self) -> tuple[ParameterResult, ...]:
        """What people read: numbers of bodies in place of the coordinates of their inertias."""
        return with_bodies(self.parameters, self.bodies)


def with_bodies(
    parameters: Sequence[ParameterResult], bodies: Sequence[ParameterResult]
) -> tuple[ParameterResult, ...]:
    """Lines with the numbers of bodies in place of the coordinates of their inertias."""
    whole = {number.name.rpartition(".")[0] for number in bodies}
    return (*(p for p in parameters if inertia_of(p.name) not in whole), *bodies)


def known_together(result: Identification) -> list[Combination]:
    """Combinations that are known more precisely than each of their parameters, best first."""
    relative = {p.name: p.sd / abs(p.estimate) for p in result.parameters if p.estimate}
    return sharper(result.combinations, relative)
