"""Messages of estimates: one type for every log that an estimator writes."""

from __future__ import annotations

from amhe_cli.estimation.online.horizon import Estimate
from amhe_cli.logs import LogWriter

ESTIMATE, PARAMETER = "amhe_msgs/msg/Estimate", "amhe_msgs/msg/ParameterEstimate"

_PARAMETER = """\
string name
string unit
float64 value
float64 sd
# central 90 % interval
float64 lower
float64 upper
"""
_ESTIMATE = """\
std_msgs/Header header
# updated, jump, still, gap or diverged
string mark
# rms residual before the update, in noise sd
float64 misfit
# rms move of the predictions under the samples, in noise sd
float64 excitation
uint32 rollouts
uint32 diverged
amhe_msgs/ParameterEstimate[] parameters
"""


def define(log: LogWriter) -> None:
    """Make the types of this module known to a log."""
    log.define(PARAMETER, _PARAMETER)
    log.define(ESTIMATE, _ESTIMATE)


def write_params(log: LogWriter, stamp_ns: int, estimate: Estimate) -> None:
    """Write the values alone, as a JointState on /amhe/params, which every viewer plots."""
    log.joint_state("/amhe/params", stamp_ns, estimate.belief.names, estimate.theta)


def write_estimate(log: LogWriter, stamp_ns: int, estimate: Estimate) -> None:
    """Write all that is a matter of log and seed alone on /amhe/estimate."""
    belief = estimate.belief
    rows = zip(
        belief.names, belief.units, estimate.theta, estimate.sd, estimate.lower, estimate.upper, strict=True
    )
    fields = ("name", "unit", "value", "sd", "lower", "upper")
    content = {
        "mark": estimate.mark,
        "misfit": estimate.misfit,
        "excitation": estimate.excitation,
        "rollouts": estimate.rollouts,
        "diverged": estimate.diverged,
        "parameters": [dict(zip(fields, row, strict=True)) for row in rows],
    }
    log.write("/amhe/estimate", ESTIMATE, stamp_ns, content)
