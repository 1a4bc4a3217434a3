"""An identification as result.json, as the files of `amhe identify`, and on a terminal."""

from __future__ import annotations

import logging
import math
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.text import Text

from amhe_cli.core.belief import Belief, belief_text, with_prior
from amhe_cli.core.errors import ConfigError
from amhe_cli.core.files import json_text, plain
from amhe_cli.core.yaml_file import YamlFile
from amhe_cli.estimation.core.result import (
    HeldOut,
    Identification,
    OwnSpread,
    ParameterResult,
    Repair,
    known_together,
)
from amhe_cli.report import numbers
from amhe_cli.report.folder import results
from amhe_cli.report.held_out import error_rows
from amhe_cli.report.identification_page import (
    ALONE,
    MAX_COMBINATIONS,
    THUMB,
    Beside,
    identification_page,
    misfit_text,
    next_steps,
)
from amhe_cli.report.missing import missing_record, print_missing, print_repairs, repairs_record
from amhe_cli.report.parameters import parted, reason_texts
from amhe_cli.report.tables import NUMBER, Table, rich_table
from amhe_cli.system.description.folders import FILE_NAME
from amhe_cli.system.export.mjcf import identified_assets, identified_xml
from amhe_cli.system.provenance import system_files
from amhe_cli.system.system import System

logger = logging.getLogger(__name__)

#: Colour of each verdict.
STYLES = {
    "identified": "green",
    "conditional": "cyan",
    "weak": "yellow",
    "prior": "dim",
    "model-sensitive": "magenta",
}

#: What a table says of conditional values, and the columns that it leaves out, from wide to narrow terminals.
_NARROWER = ((True, ()), (False, ()), (False, ("shrinkage",)), (False, ("shrinkage", "prior")))

#: Fields of a parameter in result.json, in its order.
_PARAMETER_FIELDS = (
    "name", "unit", "estimate", "prior", "prior_sd", "sd", "lower", "upper", "bounds", "shrinkage", "verdict",
    "given", "budget", "doubled_prior",
)  # fmt: skip


def identification_record(result: Identification, truth: Mapping[str, float]) -> dict[str, Any]:
    """The keys of `amhe identify`, ready for JSON; numbers that do not exist are None.

    Args:
        result: The identification.
        truth: True parameter values that the logs contain, by name; {} for logs of a real robot.
    """
    return plain(
        {
            "system": result.system,
            "method": result.method,
            "interrupted": result.interrupted,
            "fixed": result.belief.fixed,
            "exact": result.exact,
            "parameters": [_line_record(p) for p in result.parameters],
            "bodies": [_line_record(p) for p in result.bodies],
            "truth": {p.name: truth[p.name] for p in result.parameters if p.name in truth},
            "correlations": result.correlations,
            "combinations": [asdict(c) for c in result.combinations],
            "runs": [
                {
                    "log": run.log,
                    "parameters": {name: {"estimate": v, "sd": sd} for name, (v, sd) in run.values.items()},
                }
                for run in result.runs
            ],
            "spreads": [asdict(spread) for spread in result.spreads],
            "held_out": result.held_out and asdict(result.held_out),
            "rollouts": {"count": result.rollouts, "diverged": result.diverged},
            "clips": asdict(result.clips),
            "noise_scale": result.noise_scale,
            "determined": result.determined,
            "missing": missing_record(result.missing),
            "repairs": repairs_record(result.repairs),
            "iterations": len(result.iterations),
            "logs": result.logs,
        }
    )


def _line_record(line: ParameterResult) -> dict[str, Any]:
    return {name: getattr(line, name) for name in _PARAMETER_FIELDS} | {
        "reasons": [asdict(reason) for reason in line.reasons]
    }


def write_identification(
    folder: Path,
    system: System,
    result: Identification,
    belief: Belief,
    record: Mapping[str, Any],
    provenance: dict[str, object],
    force: bool = True,
    seen: Beside = ALONE,
) -> None:
    """Write belief.yaml, identified.xml (its meshes in assets/), result.json and pages, all or none.

    Args:
        folder: Folder of the files; made if it does not exist.
        system: The system that was identified.
        result: The identification.
        belief: What is believed of the system's parameters.
        record: Content of result.json.
        provenance: Versions, hashes, seed and command; goes into belief.yaml too.
        force: Write into a folder that is not empty.
        seen: A view of the result, written as view.html beside report.html.
    """
    contents = {
        "belief.yaml": belief_text(replace(belief, provenance=provenance)),
        "identified.xml": identified_xml(system, with_prior(system.space, belief).nominal),
        "result.json": json_text(record),
    }
    contents |= {"view.html": seen.page} if seen.page else {}
    with results(folder, lambda: identification_page(result, record, provenance, seen), force) as scratch:
        for name, text in contents.items():
            (scratch / name).write_text(text, encoding="utf-8")
        _write_system(scratch / "system", system, [one for one in result.repairs if one.kept])
        for name, source in identified_assets(system).items():
            if not source.is_file():  # of a model that was attached: MuJoCo does not say where it was
                logger.warning("identified.xml needs %s beside it: copy it there from the model", name)
                continue
            (scratch / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, scratch / name)


def _write_system(copy: Path, system: System, kept: Sequence[Repair]) -> None:
    """Copy a system's folder, with the parameters that were kept in its `system.yaml`."""
    if not kept or system.folder is None:
        return
    for name in system_files(system):
        above = (system.folder / folder for folder in Path(name).parents)
        if not any((folder / "result.json").exists() for folder in above):  # results are no part of it
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(system.folder / name, copy / name)
    entries = [
        (name, entry, f"{one.name}: {one.text}; {one.verdict}" * (i == 0))
        for one in reversed(kept)
        for i, (name, entry) in enumerate(one.parameters.items())
    ]
    newest = {name: (name, entry, why) for name, entry, why in reversed(entries)}
    text = YamlFile(system.folder / FILE_NAME).with_entries("parameters", [*newest.values()][::-1])
    (copy / FILE_NAME).write_text(text, encoding="utf-8")
    try:
        System.load(copy, schema=type(system.settings), warn=False)
    except ConfigError as error:
        logger.warning("the repaired copy of the system needs files beside it that are elsewhere: %s", error)


def print_identification(
    result: Identification, folder: Path | None, console: Console, truth: Mapping[str, float]
) -> None:
    """Print the parameters, the validation, and where the files are if they are written."""
    _print_parameters(result, console)
    console.print()
    if result.belief.fixed:
        console.print(f"fixed: {numbers.named(result.belief.fixed)}")
    if result.exact:
        console.print(f"taken as exact (identify.assumed): {', '.join(result.exact)}")
    for reason, names in _first_reasons(result).items():
        console.print(f"{numbers.some(names)}: {reason}", style="dim")
    for spread in result.spreads:
        console.print(spread_line(spread))
    for c in known_together(result)[:MAX_COMBINATIONS]:
        console.print(f"known together: {c.text} to {numbers.percent(c.sd)}")
    for text in result.determined:
        console.print(text)
    console.print(f"held-out: {held_out_line(result.held_out, not result.determined)}")
    if misfit := misfit_text(result):
        console.print(f"{misfit}: {THUMB}")
    if result.missing:
        print_missing(result.missing, console)
    if result.repairs:
        print_repairs(result.repairs, console)
    if result.clips.thinned:
        console.print(f"fitted: {result.clips.fitted_of}")
    if any(p.name in truth for p in result.parameters):
        console.print(truth_line(result, truth))
    if result.interrupted:
        console.print("interrupted: these are the best values so far", style="yellow")
    if folder is not None:
        for line in (
            f"report: {folder / 'report.html'}",
            *next_steps(result, folder, (folder / "view.html").exists()),
        ):
            console.print(Text(line, overflow="fold"), soft_wrap=True)


def _print_parameters(result: Identification, console: Console) -> None:
    """Print the table; a narrow terminal gets fewer columns, never cut names or numbers, and a line says so.

    Of many parameters, those that the logs hardly narrow down have one line.
    """
    rows, apart = parted(result.lines)
    for given, left_out in _NARROWER:
        table = rich_table(parameter_table(rows, given=given).without(*left_out), STYLES)
        width = console.measure(table, options=console.options.update(width=1000)).maximum
        if width <= console.width:
            break
    console.width = max(width, console.width)
    console.print(table)
    if apart:
        console.print(
            f"{len(apart)} more that the logs hardly narrow down: {numbers.some([p.name for p in apart])}"
        )
    if left_out:
        console.print(f"left out here, as the terminal is narrow: {numbers.joined(left_out)}", style="dim")


def _first_reasons(result: Identification) -> dict[str, list[str]]:
    """The first reason of each verdict but 'identified', and each bound that decides a value -> names."""
    found: dict[str, list[str]] = {}
    for p in result.lines:
        if p.reasons and (p.verdict != "identified" or p.reasons[0].kind == "bound"):
            found.setdefault(reason_texts(p)[0], []).append(p.name)
    return found


def parameter_table(parameters: Sequence[ParameterResult], *, given: bool = True) -> Table:
    """Estimate, interval, prior and verdict of each parameter.

    Args:
        parameters: The parameters, or what stands for them.
        given: Say in the line what a conditional value rests on.
    """
    return Table(
        ("parameter", "estimate ± sd", "unit", "90 % interval", "prior", "shrinkage", "verdict"),
        ("", NUMBER, "", NUMBER, NUMBER, NUMBER, ""),
        [
            (
                p.name,
                numbers.with_sd(p.estimate, p.sd),
                numbers.unit_of(p.unit),
                numbers.interval(p.lower, p.upper),
                numbers.rounded(p.prior, p.prior_sd),
                numbers.shrinkage(p.shrinkage),
                f"{p.verdict}: given {p.given}" if p.given and given else p.verdict,
            )
            for p in parameters
        ],
    )


def spread_line(spread: OwnSpread) -> str:
    """The spread in words: 'friction: spread of its 4 values about the common mean: 12 % (5 to 31 %)'."""
    count = f"{spread.name}: spread of its {len(spread.values)} values about the common mean"
    if spread.log:
        low, high = numbers.percent(spread.lower), numbers.percent(spread.upper)
        return f"{count}: {numbers.percent(spread.estimate)} ({low} to {high})"
    return f"{count}: {spread.estimate:.2g} ({spread.lower:.2g} to {spread.upper:.2g})"


def truth_line(result: Identification, truth: Mapping[str, float]) -> str:
    """The truth in words: 'true values in the logs: mass 0.55, damping 0.03; outside ...: damping'."""
    known = [p for p in result.parameters if p.name in truth]
    values = ", ".join(f"{p.name} {truth[p.name]:g}" for p in known)
    outside = [p.name for p in known if not p.lower <= truth[p.name] <= p.upper]
    verdict = f"outside the 90 % interval: {', '.join(outside)}" if outside else "inside all 90 % intervals"
    return f"true values in the logs: {values}; {verdict}"


def held_out_line(held_out: HeldOut | None, errors: bool = True) -> str:
    """The held-out cost and `errors` in words: '6 clips: cost 12.3 -> 1.04, position error 42 mm -> 9 mm'."""
    if held_out is None:
        return "nothing was held out, so the fit is not validated"
    parts = [f"cost {held_out.initial_cost:.3g} -> {held_out.cost:.3g}"]
    if math.isfinite(held_out.fitted_cost):
        parts[0] += (
            f" (with first states fitted {held_out.initial_fitted_cost:.3g} -> {held_out.fitted_cost:.3g})"
        )
    parts += [f"{name} {before} -> {after}" for name, before, after in error_rows(held_out) if errors]
    return f"{held_out.clips} clip{'s' * (held_out.clips != 1)}: {', '.join(parts)}"
