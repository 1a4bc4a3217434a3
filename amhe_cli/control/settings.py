"""Settings of the controller; a robot adds the noise of its joints."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from amhe_cli.core.settings import Positive, Range, SettingsGroup, Share


class ControlSettings(SettingsGroup):
    """MPOPI, the sampling-based MPC of `amhe run`. Each default was measured: docs/notes/control.md."""

    period: Positive = 0.02
    """Control period [s]."""
    realtime: bool = False
    """A simulation keeps pace with the wall clock; late plans cost periods."""
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
    """When to refine: L loops from each switch of the contact mode on (the paper, Algorithm 1), in every
    cycle, never."""
    elites: Share = 0.3
    """Share of the samples that refine the distribution."""
    learning_rate: Annotated[float, Field(gt=0, le=1)] = 0.5
    """How far one loop moves the variance."""
    sigma_range: Range = (0.25, 1.5)
    """Bounds of the refined sigma, as multiples of its start."""
    temperature: Positive = 0.1
    """Temperature of MPPI's weights, in units of (median - least) cost: the same for any scale of costs."""
