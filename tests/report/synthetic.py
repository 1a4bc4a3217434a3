"""An Identification made up of plausible numbers, one of every verdict, to look at and to test with."""

import numpy as np

from amhe_cli.core.belief import Belief
from amhe_cli.core.statistics import Z90
from amhe_cli.estimation.core.result import (
    ClipCount,
    Combination,
    Fit,
    HeldOut,
    Identification,
    Iteration,
    ParameterResult,
    Reason,
)

NAMES = ("load_mass", "damping", "friction_loss", "armature")
ESTIMATE = np.array([0.7421, 0.0512, 0.0118, 0.0100])
PRIOR = np.array([0.5, 0.03, 0.02, 0.01])
PRIOR_SD = np.array([0.5, 1.0, 1.0, 0.7])  # of the logarithm, as SD
SD = np.array([0.0055, 0.031, 0.42, 0.69])
VERDICTS = ("identified", "conditional", "weak", "prior")
REASONS = (
    (),
    ((0.6, "assumed", "given the gain of servo, 4: known to 10 %, that leaves 3 % open"),),
    ((0.4, "repeats", "residuals repeat from sample to sample"), (0.3, "curvature", "the response bends")),
    ((1.0, "idle", "the residuals do not change with it"),),
)
GIVEN = ("", "the gain of servo, 4", "", "")
BUDGETS = (
    {"noise": 0.8, "prior": 0.2},
    {"noise": 0.4, "assumed": 0.6},
    {"noise": 0.297, "repeats": 0.4, "curvature": 0.3, "search": 0.003},
    {"prior": 1.0},
)
CORRELATIONS = np.array(
    [[1.0, -0.31, 0.12, 0.02], [-0.31, 1.0, -0.83, -0.05], [0.12, -0.83, 1.0, 0.01], [0.02, -0.05, 0.01, 1.0]]
)


def parameter(i: int) -> ParameterResult:
    value = ESTIMATE[i]
    return ParameterResult(
        name=NAMES[i],
        unit=("kg", "N m s/rad", "N m", "kg m^2")[i],
        estimate=float(value),
        prior=float(PRIOR[i]),
        prior_sd=float(PRIOR[i] * PRIOR_SD[i]),
        sd=float(value * SD[i]),
        lower=float(value * np.exp(-Z90 * SD[i])),
        upper=float(value * np.exp(Z90 * SD[i])),
        bounds=(float(PRIOR[i] / 20), float(PRIOR[i] * 20)),
        shrinkage=float(1 - SD[i] / PRIOR_SD[i]),
        verdict=VERDICTS[i],
        reasons=tuple(Reason(kind, (NAMES[i],), size, text) for size, kind, text in REASONS[i]),
        budget=BUDGETS[i],
        doubled_prior=float(0.1 * value * SD[i]),
        given=GIVEN[i],
    )


def fit(clip: str, held_out: bool, rng: np.random.Generator) -> list[Fit]:
    time = np.arange(0, 1.5, 0.01)
    truth = 0.9 * np.exp(-0.3 * time) * np.cos(4.4 * time)
    noise = 0.01
    initial = 0.9 * np.exp(-0.2 * time) * np.cos(5.1 * time)
    measured = truth + rng.normal(0, noise, time.size)
    position = Fit(
        clip, "arm.position", ("rad",), ("hinge",), time, measured[:, None], initial[:, None],
        (truth + 0.003)[:, None], noise, held_out,
    )  # fmt: skip
    three = np.stack((truth, 0.5 * truth + 0.2, 0.3 * time - 0.4 * time**2), axis=1)
    body = Fit(
        clip, "bob.position", ("m",), ("x", "y", "z"), time, three + rng.normal(0, 0.004, three.shape),
        three * np.array([1.3, 0.6, 1.6]), three, 0.004, held_out,
    )  # fmt: skip
    return [position, body]


def identification(**changes: object) -> Identification:
    """A whole result; `changes` replace fields."""
    rng = np.random.default_rng(0)
    fits = [
        f
        for label, held in (("swing.mcap 20.00-21.50 s", True), ("swing.mcap 24.00-25.50 s", True),
                            ("swing.mcap 3.20-4.70 s", False))
        for f in fit(label, held, rng)
    ]  # fmt: skip
    start = np.log(PRIOR / ESTIMATE)
    iterations = tuple(
        Iteration(
            n + 1,
            "linearised",
            1.04 + 11.0 * np.exp(-0.9 * n),
            float(np.exp(-0.35 * n)),
            32 * 24 * (n + 1),
            3 if n == 0 else 0,
            tuple(ESTIMATE * np.exp(start * np.exp(-0.8 * n))),
        )
        for n in range(12)
    )
    values: dict = {
        "system": "pendulum",
        "method": "linearised",
        "parameters": tuple(parameter(i) for i in range(4)),
        "belief": Belief(
            "pendulum", NAMES, ("kg", "N m s/rad", "N m", "kg m^2"), (True,) * 4, ESTIMATE,
            CORRELATIONS * np.outer(SD, SD),
        ),
        "correlations": CORRELATIONS,
        "combinations": (
            Combination("damping * friction_loss^0.07", 0.012, 0.97, ("damping", "friction_loss")),
            Combination("damping^-0.07 * friction_loss", 0.42, 0.58, ("damping", "friction_loss")),
        ),
        "held_out": HeldOut(6, 1.08, 14.2, float("nan"), float("nan"), float("nan"), float("nan")),
        "iterations": iterations,
        "rollouts": 9216,
        "diverged": 3,
        "clips": ClipCount(18, 6, 2, 1),
        "noise_scale": {"arm.position": 1.03, "arm.velocity": 3.6},
        "fits": tuple(fits),
        "logs": ("logs/swing.mcap",),
    }  # fmt: skip
    return Identification(**(values | changes))
