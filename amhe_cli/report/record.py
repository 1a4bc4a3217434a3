"""What an identification found as plain values: the content of result.json."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from amhe_cli.core.files import plain
from amhe_cli.estimation.offline.result import HeldOut, Identification, ParameterResult

#: Fields of a parameter that are plain numbers or words, in the order of result.json.
_PARAMETER_FIELDS = (
    "name",
    "unit",
    "estimate",
    "prior",
    "prior_sd",
    "sd",
    "lower",
    "upper",
    "bounds",
    "shrinkage",
    "verdict",
    "reasons",
    "step_ratio",
    "bootstrap_sd",
)


def identification_record(result: Identification, truth: Mapping[str, float]) -> dict[str, Any]:
    """The keys of `amhe identify`, ready for JSON; a number that does not exist is None.

    Args:
        result: What was found.
        truth: True values that the logs tell, by parameter; {} for real ones.
    """
    return plain(
        {
            "system": result.system,
            "method": result.method,
            "interrupted": result.interrupted,
            "parameters": [_parameter(p) for p in result.parameters],
            "truth": {p.name: truth[p.name] for p in result.parameters if p.name in truth},
            "correlations": result.correlations,
            "combinations": [asdict(c) for c in result.combinations],
            "held_out": _held_out(result.held_out),
            "rollouts": {"count": result.rollouts, "diverged": result.diverged},
            "clips": asdict(result.clips),
            "noise_scale": result.noise_scale,
            "iterations": len(result.iterations),
            "logs": result.logs,
        }
    )


def _parameter(parameter: ParameterResult) -> dict[str, Any]:
    return {name: getattr(parameter, name) for name in _PARAMETER_FIELDS}


def _held_out(held_out: HeldOut | None) -> dict[str, Any] | None:
    return None if held_out is None else asdict(held_out)
