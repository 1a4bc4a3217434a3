"""`amhe audit`: the numbers of a model against what a robot did, or against another model."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from amhe_cli.cli import kinds, options
from amhe_cli.cli.command import Given, argument, command, option
from amhe_cli.cli.session import Session, in_options
from amhe_cli.core.errors import ConfigError, EstimationError, printable

if TYPE_CHECKING:
    from amhe_cli.audit.audit import Audit


@command(
    "A model's numbers against logs, or against another model.",
    argument("model", kinds.MODEL_OR_RESULT),
    argument("against", kinds.LOG_OR_MODEL, nargs=-1, metavar="[LOG|MODEL]..."),
    option(
        "vendor --against FILE",
        "Compare the numbers of this file with MODEL, the folder of a result.",
        kinds.MODEL,
    ),
    option(
        "--write NAME,...",
        "Numbers that the audited file takes from the logs, by names or patterns.  [default: those that are "
        "contradicted]",
        callback=kinds.listed,
    ),
    option(
        "--match motion|effort",
        "What is compared: the motion under the commands, or the joints' measured torques along it.  "
        "[default: torques where the log has them and any value explains them]",
        ("motion", "effort"),
    ),
    options.where,
    options.work,
    options.max_time,
    options.tuning,
    options.output,
)
def audit(session: Session, given: Given) -> None:
    """Compare every number that MODEL says with LOG, and write the file with contradicted ones replaced.

    MODEL is an MJCF or URDF file, or menagerie:NAME. Instead of logs, give another model to list what
    differs; or give the folder of a result, and the file that it is to be held against with --against.
    To try it: amhe audit example:arm example:arm. --system DIR takes from a system folder its signals, and
    parameters that no model file has: zeros, delays, a servo's supply.
    """
    from amhe_cli.cli.inputs import model_file

    model, against, vendor = given.model, given.against, given.vendor
    models = [one for one in against if kinds.is_model(one)]
    if vendor is not None and not against and Path(model).is_dir():
        _result(session, Path(model), model_file(vendor))
    elif models and len(against) == 1 and vendor is None:
        _files(session, model_file(model), model_file(models[0]))
    elif against and not models and vendor is None:
        _logs(session, model_file(model), given)
    else:
        raise click.UsageError("give MODEL and logs, MODEL and one other model, or RESULT --against FILE")


def _files(session: Session, one: Path, other: Path) -> None:
    """Print what differs between two files."""
    from amhe_cli.audit.files import compare
    from amhe_cli.report.audit import difference_record, difference_table, difference_text
    from amhe_cli.report.tables import rich_table
    from amhe_cli.system.model.files import compiled, read_spec

    found = compare(*(compiled(read_spec(path), repr(path.name)) for path in (one, other)))
    if session.gave(session.record(**difference_record(found, one, other))):
        return
    console = session.console()
    if found.differences:
        console.print(rich_table(difference_table(found, one.name, other.name)))
        console.print()
    for line in difference_text(found, one.name, other.name):
        print(printable(line))


def _result(session: Session, folder: Path, vendor: Path) -> None:
    """Print what a file says against what a result found."""
    from amhe_cli.audit.files import held_against
    from amhe_cli.cli.viewed import system_of_result
    from amhe_cli.core.belief import Belief
    from amhe_cli.system.model.files import compiled, read_spec
    from amhe_cli.system.system import System

    belief = Belief.load(folder / "belief.yaml")
    system = system_of_result(folder / "belief.yaml") or System.load(belief.system, warn=False)
    lines = held_against(system, belief, compiled(read_spec(vendor), repr(vendor.name)))
    _print(session, lines, session.record())


def _logs(session: Session, model: Path, given: Given) -> None:
    """Audit a file by logs."""
    import logging
    from dataclasses import replace
    from time import monotonic

    from amhe_cli.audit.audit import audit as run
    from amhe_cli.audit.audit import unexplained
    from amhe_cli.cli.inputs import urdf_options
    from amhe_cli.cli.progress import of_steps, progress
    from amhe_cli.cli.settings import NONE
    from amhe_cli.estimation.identification import IdentifyOptions
    from amhe_cli.init.folder import Proposal, proposed_as
    from amhe_cli.report.audit import write_audit

    folder, logs, inputs = given.reserve(), kinds.each_episode(given.against), given.inputs

    def proposal(efforts: bool) -> Proposal:
        if not inputs.system:
            return inputs.proposal(model, logs, efforts=efforts)
        system = replace(inputs, overrides=NONE).open(logs)
        return proposed_as(
            model, system.matching(given.match) if given.match else system, urdf_options(model)
        )

    def audited(proposal: Proposal, spent: float = 0.0) -> Audit:
        left = given.max_time and max(given.max_time - spent, 0.0)
        how = IdentifyOptions(**given.pick("seed", "threads", "engine"), max_time=left)
        with progress(session, "audit", of_steps) as show:
            return run(
                proposal, model.stem, lambda system: inputs.read(system.reading(inputs.topics), logs), how,
                inputs.overrides.all, lambda *step: show(step),
            )  # fmt: skip

    first, began = proposal(given.match != "motion"), monotonic()
    if given.match not in (None, first.match):
        raise ConfigError(f"--match {given.match}: these logs can only be compared by {first.match}")
    # a hobby servo's load is no torque: where the log has commands as well, they can be compared
    free, found, failed = first.match == "effort" and not (given.match or inputs.system), None, None
    try:
        found = audited(first)
    except EstimationError as error:
        failed = error
    missed = free and (found is None or (unexplained(found.found) and not found.unsearched))
    if missed and (other := proposal(False)).match == "motion":
        logging.getLogger(__name__).warning(
            "no value explains what the log has as torques: the motion under the commands is compared "
            "instead; --match effort keeps to the torques"
        )
        found = audited(other, monotonic() - began)
    elif failed:
        raise failed
    assert found is not None
    session.interrupted = found.found.interrupted
    record = session.record(out=str(folder), model=str(model))
    write_audit(
        folder, model, logs, found, given.write, record, session.command_line, given.seed, given.force,
        partial(in_options, options=session.options, quote="`"),
    )  # fmt: skip
    _print(session, found.lines, record, found)


def _print(session: Session, lines: Any, record: dict[str, object], found: Audit | None = None) -> None:
    from amhe_cli.report.audit import STYLES, audit_record, audit_table, audit_text, beside_table
    from amhe_cli.report.identification import STYLES as KNOWN
    from amhe_cli.report.missing import print_missing
    from amhe_cli.report.tables import rich_table

    if session.gave(record | audit_record(lines, found)):
        return
    console, judged = session.console(), [one for one in lines if one.verdict != "cannot tell"]
    if judged:
        console.print(rich_table(audit_table(judged), STYLES))
        console.print()
    if found and found.beside:
        console.print(rich_table(beside_table(found.beside), KNOWN))
        console.print()
    if found and found.found.missing:
        print_missing(found.found.missing, console)
    for line in audit_text(lines, found, record.get("out")):
        console.print(in_options(line, session.options), soft_wrap=True)
