"""Every setting that a user can change, with its default, unit and reason.

Precedence: command-line option, environment `AMHE_*`, `--config FILE`, the system's own `settings:`,
the default here.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from amhe_cli.core.go1_settings import Go1Settings


def _ordered(pair: tuple[float, float]) -> tuple[float, float]:
    if pair[0] > pair[1]:
        raise ValueError(f"[{pair[0]:g}, {pair[1]:g}] is the wrong way round; write the lower number first")
    return pair


_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_Share = Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)]
_Range = Annotated[tuple[_Positive, _Positive], AfterValidator(_ordered)]


class _Group(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class LogSettings(_Group):
    """How topics become a trajectory."""

    stamp: Literal["auto", "header", "publish", "log"] = "auto"
    """Which clock to trust; auto takes header stamps where they are set and monotone, and the recorder's for
    all topics where one header clock steps against it."""
    max_gap: _Positive = 0.2
    """Longest silence [s] of a topic that is interpolated; a longer one is a gap, never bridged. A topic
    slower than this is allowed five of its own median periods."""
    align: bool = False
    """Correct the estimated clock offsets between topics; they are reported in any case."""


class ClipSettings(_Group):
    """The stretches of log that are rolled out (the paper's clips, section III-B)."""

    length: _Range = (0.3, 2.0)
    """Clip lengths [s], drawn uniformly; capped by the log's own length."""
    count: Annotated[int, Field(ge=1)] = 24
    """Clips in one iteration, re-drawn for the next; fewer where they would cover the logs twice."""
    held_out: _Share = 0.25
    """Share of the logs' time kept for validation when no `--held-out` log is given."""
    held_out_length: _Positive | None = None
    """Length [s] of a validation clip; the mean of `length` where not given."""
    held_out_first_only: bool = False
    """Validate only on each held-out log's first clip instead of tiling it."""
    still: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 3.0
    """A clip is motionless, and dropped, when its motion stays within this many noise sd."""


class CostSettings(_Group):
    """The rollout-matching cost."""

    huber: _Positive = 3.0
    """Residuals beyond this many sd count linearly, not squared (pseudo-Huber)."""
    trim: _Share = 0.1
    """Share of worst clips left out of the mean: chaotic contacts and impacts of unknown cause."""


class IdentifySettings(_Group):
    """SPI: offline identification over all clips."""

    samples: Annotated[int, Field(ge=4)] = 16
    """Candidates of one iteration; the linearised method takes two for each unknown of a clip if that is
    more."""
    iterations: Annotated[int, Field(ge=1)] = 16
    """Iterations of the linearised method."""
    cmaes_iterations: Annotated[int, Field(ge=1)] = 40
    """Iterations of one CMA-ES start."""
    cmaes_starts: Annotated[int, Field(ge=1)] = 3
    """Starts of CMA-ES when it is the fallback."""
    first_state: bool = True
    """Treat each clip's first-state errors as nuisances with the sensors' noise as prior."""
    bootstrap: Annotated[int, Field(ge=0)] = 200
    """Resamples of the clip bootstrap."""
    profile_points: Annotated[int, Field(ge=0)] = 11
    """Points of each parameter's cost profile; 0 draws none."""


class ControlSettings(_Group):
    """MPOPI, the sampling-based MPC of `amhe run`. Each default was measured: docs/notes/control.md."""

    period: _Positive = 0.02
    """Control period [s]."""
    substeps: Annotated[int, Field(ge=1)] = 2
    """Steps of the planner's model in one period."""
    horizon: Annotated[int, Field(ge=2)] = 16
    """Steps H that a plan looks ahead."""
    samples: Annotated[int, Field(ge=5)] = 8
    """Rollouts N of one control cycle; three of them carry no noise, and from the fourth on every other one
    leaves the joints alone."""
    knots: Annotated[int, Field(ge=2)] = 4
    """Knots K of the cubic spline of joint targets over the horizon."""
    loops: Annotated[int, Field(ge=1)] = 3
    """Refinement loops L (the paper's L_MPOPI), one in each cycle from the switch on."""
    refine: Literal["switch", "always", "never"] = "switch"
    """When to refine: L loops from each switch of the gait's contacts on (the paper, Algorithm 1), in every
    cycle, never."""
    elites: _Share = 0.3
    """Share of the samples that refine the distribution."""
    learning_rate: Annotated[float, Field(gt=0, le=1)] = 0.5
    """How far one loop moves the variance."""
    sigma_range: _Range = (0.25, 1.5)
    """Bounds of the refined sigma, as multiples of its start."""
    temperature: _Positive = 0.1
    """Of MPPI's weights, in units of (median - least) cost: the same for cheap and dear situations."""
    sigma_hip: _Positive = 0.006
    """Noise of the hips' knots [rad]."""
    sigma_thigh: _Positive = 0.012
    """Noise of the thighs' knots [rad]."""
    sigma_calf: _Positive = 0.012
    """Noise of the calves' knots [rad]."""


class Settings(_Group):
    """All settings."""

    logs: LogSettings = LogSettings()
    clips: ClipSettings = ClipSettings()
    cost: CostSettings = CostSettings()
    identify: IdentifySettings = IdentifySettings()
    control: ControlSettings = ControlSettings()
    go1: Go1Settings = Go1Settings()
