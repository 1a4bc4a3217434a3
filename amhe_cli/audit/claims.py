"""What a model file claims: every number that decides a motion, as a parameter with the sd of its kind.

A data sheet is worth what `identify.assumed` says. Of a number that the file leaves at zero it is a share of
what would act on the joint as much as its inertia does.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from amhe_cli.check.model import WORTHWHILE
from amhe_cli.core.settings import AssumedSettings
from amhe_cli.init.drives import command_zeros, delay, measured_joints, moved_by, short, zeros
from amhe_cli.init.folder import Proposal
from amhe_cli.init.signals import Guess
from amhe_cli.system.description.targets import IN_NO_FILE
from amhe_cli.system.model.elements import driven_joint
from amhe_cli.system.model.files import compiled
from amhe_cli.system.numbers import ModelNumber, numbers_of
from amhe_cli.system.parameters.servos import OF_SERVO

#: Kind of number -> its setting in `identify.assumed`.
_SETTINGS = {"inertia": "mass", "actuator_damping": "gain"}
#: A number that is left at zero is known to this share of what would stop a joint within a second, of what
#: would take 1 rad/s^2 off it, or of its inertia.
_ZERO = {"damping": 0.05, "friction_loss": 0.05, "armature": 0.01}
#: Kind of number -> how a parameter sets it.
_MODES = {"inertia": {"mode": "scale"}, "mass": {"carry_inertia": False}}
#: Sd of a number whose data sheet is not believed: of its logarithm, of a length [m], and of one that was
#: zero, in units of its own sd.
WIDE, WIDE_LENGTH, WIDE_ZERO = 1.5, 0.15, 1000.0
#: Bounds of a number, as factors and in units of the sd of zeros, and of a length [m].
_RANGE, _RANGE_LENGTH = 300.0, 0.5

#: Numbers on one data sheet: their kind, and their element or value.
Group = tuple[str, str]


@dataclass(frozen=True, slots=True)
class Claim:
    """One number of a file.

    Args:
        parameter: Name of the parameter that sets it.
        value: What the file says.
        factor: The parameter's value where the number is 1 (a scale), else 1.
        log: Whether the parameter is on the logarithmic scale.
        sd: How far it may be off, on that scale.
        wide: The same, where the data sheet is not believed.
        nominal: The parameter's value that the search starts from.
    """

    number: ModelNumber
    parameter: str
    value: float
    factor: float
    log: bool
    sd: float
    wide: float
    nominal: float

    @property
    def group(self) -> Group:
        """Equal numbers of one kind stand on one data sheet, and so do the axes of a centre of mass."""
        if self.number.kind == "center_of_mass":
            return self.number.kind, self.number.of
        return self.number.what, f"{self.value:.6g}"

    @property
    def least(self) -> float:
        """The least that it may be, on the parameter's scale: no friction is negative."""
        return -np.inf if self.log or self.number.kind == "center_of_mass" else 0.0

    @property
    def worth(self) -> float:
        """The sd of a data sheet that is right, in the number's unit."""
        return float(-self.value * np.expm1(-self.sd)) if self.log else self.sd

    def phi(self, value: float) -> float:
        """The parameter of a value of the number, on the parameter's scale."""
        return float(np.log(value / self.factor)) if self.log else value / self.factor

    def guess(self, believed: bool) -> Guess:
        """The entry of a system file."""
        # a mass leaves the inertia as it is: that is a number of its own
        target = self.number.target | _MODES.get(self.number.kind, {})
        if self.log:
            bounds = [self.nominal / _RANGE, self.nominal * _RANGE]
        elif self.least:
            bounds = [self.nominal - _RANGE_LENGTH, self.nominal + _RANGE_LENGTH]
        else:
            bounds = [0.0, 10.0 * self.wide]
        entry: dict[str, Any] = {
            "nominal": self.nominal,
            "bounds": bounds,
            "scale": "log" if self.log else "linear",
            "prior_sd": self.sd if believed else self.wide,
            "targets": [target],
        }
        return Guess(
            self.parameter, entry, f"{self.number.what} of {self.number.of}, {self.value:g} in the file"
        )


def claims_of(proposal: Proposal, settings: AssumedSettings) -> list[Claim]:
    """What the model of a proposal claims about joints that its log measures, and what they carry.

    Where 'effort' is matched, nothing is claimed of actuators: their torques were measured.
    """
    model = compiled(proposal.spec)
    joints, actuators = measured_joints(model, proposal.guesses), moved_by(proposal.guesses)
    bodies = _carried(model, joints)
    found = []
    for number in numbers_of(model):
        own = {"body": bodies, "joint": joints, "actuator": actuators}[number.element]
        if number.of in own and not (proposal.match == "motion" and _twice(model, number)):
            found += _claim(model, number, settings)
    taken = [claim.parameter for claim in found]
    return [
        replace(c, parameter=f"{c.number.element}_{c.parameter}") if taken.count(c.parameter) > 1 else c
        for c in found
    ]


def doubts_of(proposal: Proposal) -> list[Guess]:
    """What no file claims, and logs depend on: zeros of sensors and commands, delay, what a system adds."""
    model, signals = compiled(proposal.spec), proposal.guesses
    if proposal.match == "effort":
        return [one for one in proposal.parameters if one.entry["targets"][0].get("set") == "bias"]
    found = list(zeros(model, measured_joints(model, signals), signals))
    found += delay(model.opt.timestep) if moved_by(signals) else []
    own = [one for one in proposal.parameters if one.entry["targets"][0].get("set") in IN_NO_FILE]
    taken = [target for one in own for target in one.entry["targets"]]
    if not any(target["set"] in OF_SERVO for target in taken):  # firmware counts from its encoder's zero
        found += command_zeros(model, signals)
    return [one for one in found if one.entry["targets"][0] not in taken] + own


def sheet_of(number: ModelNumber, model: mujoco.MjModel, settings: AssumedSettings) -> float:
    """What a data sheet is worth: the sd of a number, in its unit; 0 where it was measured."""
    share, value = float(getattr(settings, _SETTINGS.get(number.kind, number.kind))), number.value(model)
    if number.kind == "center_of_mass" or not share:
        return share
    if value or number.kind not in _ZERO:
        return share * abs(value)
    return short(_ZERO[number.kind] * float(model.dof_M0[model.joint(number.of).dofadr[0]]))


def _claim(model: mujoco.MjModel, number: ModelNumber, settings: AssumedSettings) -> Iterator[Claim]:
    name = f"{number.of}_{number.kind}{number.target.get('axis', '') and '_' + number.target['axis']}"
    value, sd = number.value(model), sheet_of(number, model, settings)
    if not sd:
        return  # it was measured, and is exact; or it is none
    if number.kind == "center_of_mass":
        yield Claim(number, name, value, 1.0, False, sd, WIDE_LENGTH, value)
    elif value > 0.0:
        factor, sd = value if number.kind == "inertia" else 1.0, -float(np.log1p(-sd / value))
        yield Claim(number, name, value, factor, True, sd, max(WIDE, sd), value / factor)
    elif value == 0.0:
        yield Claim(number, name, 0.0, 1.0, False, sd, WIDE_ZERO * sd, 0.1 * sd)


def _carried(model: mujoco.MjModel, joints: Collection[str]) -> set[str]:
    """Bodies that measured joints move, without the small ones among those that are welded together."""
    rows = {int(model.joint(joint).bodyid[0]) for joint in joints}
    found = set()
    for row in range(1, model.nbody):
        above, weld = row, model.body_weldid[row]
        while above and above not in rows:
            above = int(model.body_parentid[above])
        if above and model.body_mass[row] > WORTHWHILE * model.body_mass[model.body_weldid == weld].sum():
            found.add(model.body(row).name)
    return found


def _twice(model: mujoco.MjModel, number: ModelNumber) -> bool:
    """Whether a log shows only the sum of it and a larger number: of a servo's kv and its joint's damping."""
    if number.kind not in ("damping", "actuator_damping"):
        return False
    kv = {
        joint: max(0.0, float(-model.actuator_biasprm[row, 2]))
        for row in range(model.nactuator)
        if (joint := driven_joint(model, row))
        and model.actuator_biastype[row] == mujoco.mjtBias.mjBIAS_AFFINE
    }
    joint = number.of if number.kind == "damping" else driven_joint(model, model.actuator(number.of).id)
    if joint not in kv:
        return number.kind == "actuator_damping"
    damping = float(model.dof_damping[model.joint(joint).dofadr[0]])
    return (kv[joint] > damping) == (number.kind == "damping")
