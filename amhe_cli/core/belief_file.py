"""`belief.yaml`: a Gaussian belief over parameters, and where it came from.

The covariance is that of phi: log(value) for parameters of scale log, the value itself for linear ones.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from amhe_cli.core.parameters import Belief, Described, mistakes_of
from amhe_cli.core.statistics import Z90
from amhe_cli.core.yaml_file import Place, YamlFile

SCHEMA_VERSION = 1

_HEADER = """\
# What is believed of the parameters of a system: an estimate, and how sure it is.
# `covariance` is of log(estimate) where scale is log, of the estimate where it is linear;
# `sd`, `lower` and `upper` (90 %) follow from it and are for people: reading ignores them.
"""


class _Entry(BaseModel):
    model_config = ConfigDict(extra="forbid")
    name: str
    unit: str = "-"
    scale: Literal["log", "linear"]
    estimate: FiniteFloat
    sd: float | None = None
    lower: float | None = None
    upper: float | None = None


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid")
    schema_version: Literal[1]
    system: str
    parameters: Annotated[list[_Entry], Field(min_length=1)]
    covariance: list[list[FiniteFloat]]
    provenance: dict[str, Any] = {}


def belief_text(belief: Belief) -> str:
    """The content of a belief file."""
    sd = np.sqrt(np.diag(belief.covariance))
    document = {
        "schema_version": SCHEMA_VERSION,
        "system": belief.system,
        "parameters": [_entry(belief, i, float(sd[i])) for i in range(len(belief.names))],
        "covariance": belief.covariance.tolist(),
        "provenance": belief.provenance,
    }
    return _HEADER + yaml.safe_dump(document, sort_keys=False, allow_unicode=True, width=110)


def _entry(belief: Belief, i: int, sd: float) -> dict[str, object]:
    estimate = float(belief.estimate[i])
    factor = float(np.exp(Z90 * sd))
    return {
        "name": belief.names[i],
        "unit": belief.units[i],
        "scale": "log" if belief.log[i] else "linear",
        "estimate": estimate,
        "sd": estimate * sd if belief.log[i] else sd,
        "lower": estimate / factor if belief.log[i] else estimate - Z90 * sd,
        "upper": estimate * factor if belief.log[i] else estimate + Z90 * sd,
    }


def read_belief(path: Path, system: Described | None = None) -> Belief:
    """Read a belief.

    Args:
        path: The file.
        system: The system that the belief must be about; None: any.

    Raises:
        ConfigError: The file is no belief, not about this system, or of other parameters; every mistake
            in one go, as `file:line:column: what, what would be valid`.
    """
    file = YamlFile(path)
    try:
        content = _File.model_validate(file.data)
    except ValidationError as error:
        for mistake in error.errors(include_url=False):
            file.problem(mistake["loc"], f"{_label(mistake['loc'])}: {mistake['msg'].lower()}")
        file.raise_problems()
        raise
    _check(file, content, system)
    return Belief(
        system=content.system,
        names=tuple(entry.name for entry in content.parameters),
        units=tuple(entry.unit for entry in content.parameters),
        log=tuple(entry.scale == "log" for entry in content.parameters),
        estimate=np.array([entry.estimate for entry in content.parameters]),
        covariance=np.array(content.covariance),
        provenance=content.provenance,
    )


def belief_for(system: Described, given: Belief | str | Path) -> Belief:
    """A belief that a system can start from: one in memory, or that of a file.

    Raises:
        ConfigError: The belief does not suit the system.
    """
    if not isinstance(given, Belief):
        return read_belief(Path(given), system)
    given.check(system)
    return given


def _check(file: YamlFile, content: _File, system: Described | None) -> None:
    """Refuse what no belief, or no prior of this system, can be."""
    if system is not None and content.system != system.name:
        file.problem(("system",), f"this belief is about {content.system!r}, not about {system.name!r}")
        file.raise_problems()
    names = [entry.name for entry in content.parameters]
    for i, entry in enumerate(content.parameters):
        place = ("parameters", i)
        if names.count(entry.name) > 1:
            file.problem((*place, "name"), f"parameter {entry.name!r} is here twice")
        elif system is not None:
            for key, text in mistakes_of(entry.name, entry.scale == "log", entry.estimate, system.space):
                file.problem((*place, key), text)
    mistake = _covariance_mistake(content.covariance, len(names))
    if mistake:
        file.problem(("covariance",), mistake)
    file.raise_problems()


def _covariance_mistake(rows: list[list[float]], size: int) -> str | None:
    if len(rows) != size or any(len(row) != size for row in rows):
        return f"covariance must be {size} x {size}: a row and a column for each parameter"
    covariance = np.array(rows)
    if not np.allclose(covariance, covariance.T) or np.linalg.eigvalsh(covariance).min() <= 0.0:
        return "covariance must be symmetric and positive definite"
    return None


def _label(place: Place) -> str:
    return ".".join(str(part) for part in place) or "this file"
