"""What a file says against what an identification found."""

from __future__ import annotations

import mujoco
import numpy as np

from amhe_cli.audit.audit import VERDICTS, Line, in_order
from amhe_cli.audit.claims import sheet_of
from amhe_cli.audit.files import partners
from amhe_cli.audit.judge import chances, contradicted
from amhe_cli.audit.weight import anywhere, weights
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.belief import Belief
from amhe_cli.core.parameters import theta_of
from amhe_cli.core.settings import AssumedSettings
from amhe_cli.system.numbers import ModelNumber, numbers_of
from amhe_cli.system.system import System

#: Step of a parameter for its slope, in its sd.
_STEP = 0.1


def held_against(system: System, belief: Belief, file: mujoco.MjModel) -> list[Line]:
    """The numbers of a file that the parameters of a result set, and whether the result contradicts them.

    Args:
        system: The system of the result.
        belief: What it found.
        file: The model of the file; names are matched as between two files.
    """
    space = system.space.with_prior(belief)
    model = system.edits.apply(system.model, space.nominal)
    theirs = {(n.kind, n.of, n.what): n for n in numbers_of(model)}
    pairs = partners(file, model)[0]
    found: list[tuple[ModelNumber, ModelNumber, float, float]] = []
    for number in numbers_of(file):
        own = theirs.get((number.kind, pairs[number.element].get(number.of, ""), number.what))
        share = sheet_of(number.kind, AssumedSettings())
        if own is None or not share:
            continue
        slope = _slope(system, space.nominal, own)
        sd = float(np.sqrt(slope @ belief.covariance @ slope))
        if sd > 0.0:
            size = 1.0 if number.kind == "center_of_mass" else abs(number.value(file))
            found.append((number, own, sd, share * size))
    log, said, sd, sheet = (
        np.array([of(row) for row in found])
        for of in (lambda r: r[1].value(model), lambda r: r[0].value(file), lambda r: r[2], lambda r: r[3])
    )
    t = (log - said) / np.sqrt(sd**2 + sheet**2)
    wrong = contradicted(chances(t))
    verdicts = np.where(
        wrong, VERDICTS[0], np.where(sd <= np.maximum(sheet, 1e-12), VERDICTS[1], VERDICTS[2])
    )
    others = [own.written(model, number.values(file)) for number, own, *_ in found]
    worth = weights(model, others, anywhere(model))
    return in_order(
        Line(
            n.of, n.what, n.unit, "", float(said[i]), float(log[i]), float(sd[i]), float(t[i]),
            float(chances(t[i : i + 1])[0]), str(verdicts[i]), worth[i], "",
        )
        for i, (n, *_) in enumerate(found)
    )  # fmt: skip


def _slope(system: System, theta: FloatArray, number: ModelNumber) -> FloatArray:
    """Derivative of a number by the parameters on their own scales, shape (d,)."""
    space, slope = system.space, np.zeros(len(theta))
    for i, p in enumerate(space.parameters):
        step = _STEP * p.prior_sd
        ends = []
        for way in (-step, step):
            phi = space.phi_of(theta)
            phi[i] += way
            ends.append(number.value(system.edits.apply(system.model, theta_of(space.log, phi))))
        slope[i] = (ends[1] - ends[0]) / (2.0 * step)
    return slope
