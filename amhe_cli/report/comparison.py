"""Several models compared, or several beliefs pooled: tables, result.json and report.html."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from markupsafe import Markup

from amhe_cli.core.belief import Belief
from amhe_cli.core.files import json_text, plain
from amhe_cli.estimation.core.agreement import Agreement
from amhe_cli.estimation.core.result import AtHorizon, Identification
from amhe_cli.estimation.validation.prediction import FEWEST, Compared
from amhe_cli.report import numbers
from amhe_cli.report.folder import results
from amhe_cli.report.held_out import sized
from amhe_cli.report.page import Section, Statement, result_page
from amhe_cli.report.tables import NUMBER, STRONG, PlainConsole, Table, rich_table


def comparison_table(names: Sequence[str], horizons: Sequence[AtHorizon], best: int) -> Table:
    """Rms error of each system at each horizon, over all joints and poses of a unit, beside the best."""
    rows = []
    for at in horizons:
        units = list(dict.fromkeys(unit for _, unit in at.errors))
        for i, name in enumerate(names):
            after, clips = (
                (f"after {at.horizon:.3g} s{' (end)' * at.to_end}", str(at.clips)) if i == 0 else ("", "")
            )
            error = ", ".join(sized(together(at, i, unit), unit) for unit in units)
            rows.append((after, clips, name, error, "" if i == best else _ratio(at, i, best)))
    head = ("", "clips", "model", "error", f"over that of {names[best]} (95 %)")
    return Table(head, ("", NUMBER, "name", STRONG, NUMBER), rows)


def _ratio(at: AtHorizon, i: int, best: int) -> str:
    """A ratio with its interval, or why there is none."""
    if at.clips < FEWEST:
        return "too few clips"
    if np.isnan(at.lower[i, best]):
        return numbers.MISSING
    return f"{at.ratios[i, best]:.2f} ({at.lower[i, best]:.2f} to {at.upper[i, best]:.2f})"


def comparison_record(compared: Compared) -> dict[str, Any]:
    """The keys of `amhe compare`, ready for JSON."""
    names, best = compared.names, compared.best
    return plain(
        {
            "systems": [_system_record(name, one) for name, one in zip(names, compared.found, strict=True)],
            "best": names[best] if _settled(compared) else None,
            "verdicts": list(compared.verdicts),
            "horizons": [horizon_record(names, at, best) for at in compared.horizons],
        }
    )


def _settled(compared: Compared) -> bool:
    """Whether every search has ended whose model may still come to predict best."""
    return all(one.settled for i, one in enumerate(compared.found) if i != compared.best)


def _system_record(name: str, found: Identification) -> dict[str, Any]:
    known = {p.name: {"estimate": p.estimate, "sd": p.sd, "verdict": p.verdict} for p in found.parameters}
    return {"name": name, "parameters": known, "held_out": found.held_out and asdict(found.held_out)}


def horizon_record(names: Sequence[str], at: AtHorizon, best: int) -> dict[str, Any]:
    """Errors at one horizon, and their ratios to those of the best system, for result.json."""
    return {
        "horizon": at.horizon,
        "to_end": at.to_end,
        "clips": at.clips,
        "errors": [
            {"joint": joint, "unit": unit, "errors": dict(zip(names, errors.tolist(), strict=True))}
            for (joint, unit), errors in at.errors.items()
        ],
        "against_best": {
            name: {"ratio": at.ratios[i, best], "lower": at.lower[i, best], "upper": at.upper[i, best]}
            for i, name in enumerate(names)
            if i != best
        },
    }


def write_comparison(
    folder: Path, compared: Compared, record: Mapping[str, Any], provenance: Mapping[str, Any]
) -> None:
    """Write result.json and report.html, both or none.

    Args:
        folder: Folder of the files; made if it does not exist.
        compared: The comparison.
        record: Content of result.json; of friction models its `lines` say how to go on.
        provenance: Versions, hashes, seed and command.
    """
    with results(folder, lambda: _page(compared, record, provenance), force=True) as scratch:
        (scratch / "result.json").write_text(json_text(record), encoding="utf-8")


def _page(compared: Compared, record: Mapping[str, Any], provenance: Mapping[str, Any]) -> str:
    names, horizons, best, verdicts = compared.names, compared.horizons, compared.best, compared.verdicts
    settled = _settled(compared)
    clear = settled and not any("cannot decide" in text for text in verdicts)
    headline = f"{names[best]} predicts best." if clear else "The logs do not single out one model."
    if lines := record.get("lines", ()):
        headline = f"{names[best]} is the smallest model within one standard error of the best."
    return result_page(
        record,
        provenance,
        title=" against ".join(names) if len(names) == 2 else numbers.joined(names),
        facts=(
            f"{len(names)} models",
            f"{max(at.clips for at in horizons)} clips that were not fitted, at most",
        ),
        headline=headline if settled else "The logs do not single out one model yet.",
        statements=[
            Statement(
                "mixed" if "cannot decide" in text or not settled else "good",
                f"{text}." if text.startswith(tuple(names)) else f"{text[0].upper()}{text[1:]}.",
            )
            for text in verdicts
        ],
        sections=[
            Section(
                "Error against horizon",
                text="Each model was fitted to the same logs. Predictions start from recorded states of "
                "clips that were not fitted, and follow the recorded commands. The error is the rms after so "
                f"much time, over all joints. Behind it: the ratio to that of {names[best]} on the same "
                "clips, with the 95 % interval of a bootstrap over clips; each joint counts in units of its "
                "usual error. Above 1 the model is worse; an interval that holds 1 decides nothing, nor "
                f"do fewer than {FEWEST} clips.",
                table=comparison_table(names, horizons, best),
            ),
            *([Section("Each joint", table=_joint_table(names, horizons))] * (len(horizons[0].errors) > 1)),
            Section("What was identified", table=_model_table(names, compared.found)),
            *([Section("Next", text=lines[0], items=lines[1:], files=True)] if lines else ()),
        ],
    )


def _joint_table(names: Sequence[str], horizons: Sequence[AtHorizon]) -> Table:
    lines = list(dict.fromkeys(key for at in horizons for key in at.errors))
    rows = [
        (joint, name, *(sized(float(at.errors[joint, unit][i]), unit) for at in horizons))
        for joint, unit in lines
        for i, name in enumerate(names)
    ]
    return Table(("", "model", *heads(horizons)), ("name", "", *(NUMBER for _ in horizons)), rows)


def _model_table(names: Sequence[str], found: Sequence[Identification]) -> Table:
    rows = []
    for name, one in zip(names, found, strict=True):
        known = sum(p.verdict == "identified" for p in one.parameters)
        cost = numbers.MISSING if one.held_out is None else f"{one.held_out.cost:.3g}"
        link = Markup('<a href="{0}/report.html">report</a>').format(quote(name))
        rows.append((name, f"{len(one.parameters)}", f"{known}", cost, link))
    head = ("model", "parameters", "identified", "held-out cost", "")
    return Table(head, ("name", NUMBER, NUMBER, STRONG, ""), rows)


def heads(horizons: Sequence[AtHorizon]) -> list[str]:
    """'after 0.5 s' of each horizon."""
    return [f"after {at.horizon:.3g} s{' (end)' * at.to_end}" for at in horizons]


def together(at: AtHorizon, i: int, unit: str) -> float:
    """Rms error of a system over all joints and poses of a unit."""
    return float(np.sqrt(np.mean([errors[i] ** 2 for (_, own), errors in at.errors.items() if own == unit])))


def table_text(table: Table) -> str:
    """A table as plain text."""
    console = PlainConsole(record=True, file=io.StringIO(), width=110, force_jupyter=False)
    console.print(rich_table(table))
    return console.export_text().rstrip("\n")


#: Beliefs that have a column of their own.
_SHOWN = 4


def pool_table(
    sources: Sequence[str],
    beliefs: Sequence[Belief],
    pooled: Belief,
    differences: Sequence[tuple[str, str, str, float]],
) -> Table:
    """Each parameter in each belief and in the pooled one, and the two that differ most.

    Args:
        sources, beliefs: Paths or names of the beliefs, and the beliefs.
        pooled: What they say together.
        differences: Parameter, the two sources that differ most, and by how many sd.
    """
    shown = list(zip(sources, beliefs, strict=True)) if len(beliefs) <= _SHOWN else []
    farthest = {name: (one, other, size) for name, one, other, size in differences}
    rows = [
        (
            name,
            *(_with_sd(belief, name) for _, belief in shown),
            _with_sd(pooled, name),
            unit if unit != "-" else "",
            f"{farthest[name][2]:.1f} sd",
            *(() if len(beliefs) == 2 else (" and ".join(map(_short, farthest[name][:2])),)),
        )
        for name, unit in zip(pooled.names, pooled.units, strict=True)
    ]
    between = () if len(beliefs) == 2 else ("between",)
    head = (
        "parameter",
        *(_short(source) for source, _ in shown),
        "pooled ± sd",
        "unit",
        "differ by",
        *between,
    )
    looks = ("", *(NUMBER for _ in shown), STRONG, "", NUMBER, *("" for _ in between))
    return Table(head, looks, rows)


def pool_record(
    sources: Sequence[str],
    pooled: Belief,
    found: Agreement,
    differences: Sequence[tuple[str, str, str, float]],
) -> dict[str, Any]:
    """The keys of `amhe pool --json`."""
    return plain(
        {
            "beliefs": sources,
            "chi_square": found.chi_square,
            "freedom": found.freedom,
            "chance": found.chance,
            "parameters": [
                {"name": name, "estimate": estimate, "sd": sd}
                for name, estimate, sd in zip(pooled.names, pooled.estimate, pooled.sd, strict=True)
            ],
            "differences": [
                {"name": name, "between": [one, other], "sd": size} for name, one, other, size in differences
            ],
        }
    )


def _with_sd(belief: Belief, name: str) -> str:
    if name not in belief.names:
        return numbers.MISSING
    row = belief.names.index(name)
    return numbers.with_sd(float(belief.estimate[row]), float(belief.sd[row]))


def _short(source: str) -> str:
    """'monday' of monday/belief.yaml."""
    path = Path(source)
    return path.parent.name if path.name == "belief.yaml" and path.parent.name else path.stem
