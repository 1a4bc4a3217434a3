"""An audit of a model's numbers: as a table, as JSON, as a page, and as the file with right numbers."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from amhe_cli.audit.audit import VERDICTS, Audit, Line, unexplained
from amhe_cli.audit.files import FileDifference, FilesCompared
from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.core.files import json_text, plain
from amhe_cli.estimation.core.result import Identification, ParameterResult
from amhe_cli.report import numbers
from amhe_cli.report.folder import results
from amhe_cli.report.identification import held_out_line
from amhe_cli.report.identification_page import overlay_section
from amhe_cli.report.missing import missing_record, missing_section
from amhe_cli.report.page import Section, Statement, result_page
from amhe_cli.report.tables import NUMBER, ONCE, STRONG, VERDICT, Table
from amhe_cli.system.export.mjcf import identified_assets, identified_xml, with_comments
from amhe_cli.system.export.urdf import identified_urdf
from amhe_cli.system.model.urdf import is_urdf
from amhe_cli.system.provenance import provenance

#: Colour of each verdict.
STYLES = {"contradicted": "red", "agrees": "green", "cannot tell": "dim"}
#: What stands in the columns of the table.
_COLUMNS = (
    "± in the file: what a data sheet is taken to be worth, by `identify.assumed`. In the log: what it says "
    "of a number whatever the file says of it, with all other numbers as their data sheets have them. "
    "Contradicted: 5 % of right files have such a verdict by chance. Of forces: what the difference is "
    "worth, as a share of the joints' forces along the motion. More than 100 %: with the file's number they "
    "would differ by more than all the force that the joints gave."
)


def audit_table(lines: Sequence[Line]) -> Table:
    """The numbers of a file, and what the log says of them; a part is named once."""
    rows = []
    for line in lines:
        wrong, judged = line.verdict == VERDICTS[0], line.verdict != VERDICTS[2]
        rows.append(
            (
                line.of, ", ".join(filter(None, (line.what, numbers.unit_of(line.unit)))),
                f"{line.verdict}: {abs(line.t):.1f} sd" if judged else line.verdict,
                _in_file(line),
                numbers.with_sd(line.log, line.sd) if _shown(line) else numbers.MISSING,
                numbers.percent(line.weight) if wrong else "",
            )
        )  # fmt: skip
    head = ("part", "number", "verdict", "in the file", "in the log", "of forces")
    return Table(head, (ONCE, "", VERDICT, NUMBER, STRONG, NUMBER), rows, [line.cure for line in lines])


def _in_file(line: Line) -> str:
    """'2.4 ± 10 %', or '0.12 ± 0.01' of a length: what the file says, and what that is taken to be worth."""
    if line.file and line.unit != "m":
        return f"{line.file:.4g} ± {numbers.percent(line.file_sd / abs(line.file))}"
    return f"{line.file:.4g} ± {line.file_sd:.2g}"


def _shown(line: Line) -> bool:
    """Whether a log says anything of a number: else its value is what arithmetic left."""
    return line.verdict != VERDICTS[2] or line.sd < max(abs(line.file), abs(line.log))


def beside_table(found: Sequence[ParameterResult]) -> Table:
    """What was identified beside the file's numbers."""
    rows = [
        (
            one.name, one.verdict, numbers.quantity(numbers.with_sd(one.prior, one.prior_sd), one.unit),
            numbers.with_sd(one.estimate, one.sd),
        )
        for one in found
    ]  # fmt: skip
    return Table(
        ("beside the file", "verdict", "assumed", "in the log"),
        ("", VERDICT, NUMBER, STRONG),
        rows,
    )


def audit_text(lines: Sequence[Line], found: Audit | None, out: object = None) -> Iterator[str]:
    """What is said below the table: what would decide the rest, and how well the logs are explained."""
    cures: dict[str, list[str]] = {}
    for line in lines:
        if line.verdict == VERDICTS[2]:
            cures.setdefault(line.cure, []).append(f"{line.of} {line.what}")
    for cure, names in cures.items():
        yield f"cannot tell {numbers.some(names)}{': ' * bool(cure)}{cure}"
    yield count_text(lines)
    if found is not None:
        yield from _against(found)
        yield from _compared(found.found)
        yield f"held-out: {held_out_line(found.found.held_out)}"
    if out is not None:
        yield f"report: {out}/report.html"


def _against(audit: Audit) -> Iterator[str]:
    """What speaks against all numbers of a table."""
    found, refused = audit.found, unexplained(audit.found)
    for one in (one for one in found.unexplained if not (audit.unsearched and one.kind == "short")):
        yield (
            f"the logs are not explained: {one.text}"
            if refused
            else f"{one.text}: every sd is wider by that factor"
        )
    if audit.unsearched:
        yield audit.unsearched
    elif not found.settled:
        yield (
            "the search stopped before it settled: the sd of a number includes how far it may still move; "
            "give it more `identify.iterations`"
        )


def _compared(found: Identification) -> Iterator[str]:
    """That some clips stand for all of long logs."""
    if found.clips.thinned:
        yield f"of these logs {found.clips.fitted_of} were compared, spread evenly over them"


def count_text(lines: Sequence[Line]) -> str:
    """'3 contradicted, 9 agree, 21 undecided by these logs'."""
    counts = [sum(line.verdict == verdict for line in lines) for verdict in VERDICTS]
    return f"{counts[0]} contradicted, {counts[1]} agree, {counts[2]} undecided by these logs"


def audit_record(lines: Sequence[Line], found: Audit | None) -> dict[str, Any]:
    """The keys of `amhe audit --json` and audit.json."""
    silent = {"log": None, "sd": None}
    listed = {"numbers": [asdict(line) | ({} if _shown(line) else silent) for line in lines]}
    if found is None:
        return plain(listed)
    held_out, missing = found.found.held_out, missing_record(found.found.missing)
    beside = [
        {
            name: getattr(one, name)
            for name in ("name", "unit", "verdict", "prior", "prior_sd", "estimate", "sd")
        }
        for one in found.beside
    ]
    about = {
        "match": found.system.match,
        "beside": beside,
        "held_out": held_out and asdict(held_out),
        "missing": missing,
    }
    about |= {"interrupted": found.found.interrupted, "settled": found.found.settled}
    about |= {"unsearched": found.unsearched}
    return plain(listed | about)


def write_audit(
    folder: Path,
    model: Path,
    logs: Sequence[Path],
    found: Audit,
    chosen: Sequence[str],
    record: Mapping[str, Any],
    command: str,
    seed: int,
    force: bool,
    typed: Callable[[str], str],
) -> None:
    """Write audit.json, report.html and robot.audited.xml or .urdf, all or none.

    Args:
        folder: Folder of the files.
        model: The file that was audited.
        logs: The logs.
        found: The audit.
        chosen: Parameters, or patterns, whose numbers are taken from the log; none: those contradicted.
        record: Head of audit.json.
        command, seed: How it was made.
        force: Write into a folder that is not empty.
        typed: A text of the library as the user of the command reads it.
    """
    origin = provenance(command, seed, "linearised", found.system, logs, ())
    record = {**record, **audit_record(found.lines, found)}
    taken = _taken(found.lines, chosen)
    with results(folder, lambda: _page(found, model, record, origin, typed), force) as scratch:
        (scratch / "audit.json").write_text(json_text(record), encoding="utf-8")
        if not taken:
            return
        names = ", ".join(log.name for log in logs)
        corrected = found.with_only([line.parameter for line in taken])
        claims = {claim.parameter: claim for claim in found.claims}
        theta = np.array([line.log / claims[line.parameter].factor for line in taken])
        theta = theta[[[line.parameter for line in taken].index(name) for name in corrected.space.names]]
        whole = is_urdf(model)
        text = identified_urdf(corrected, theta, model) if whole else identified_xml(corrected, theta)
        comments: dict[tuple[str, str], list[str]] = {}
        for line in taken:
            was = f"{line.what} {line.file:.4g} -> {_said(line)}"
            comments.setdefault((claims[line.parameter].number.element, line.of), []).append(
                f"{was}, by amhe audit of {names}"
            )
        (scratch / f"robot.audited{model.suffix}").write_text(with_comments(text, comments), encoding="utf-8")
        for name, source in ({} if whole else identified_assets(corrected)).items():
            if source.is_file():
                (scratch / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(source, scratch / name)


def _taken(lines: Sequence[Line], chosen: Sequence[str]) -> list[Line]:
    """The numbers that are replaced."""
    if not chosen:
        return [line for line in lines if line.verdict == VERDICTS[0]]
    for pattern in chosen:
        if not any(fnmatchcase(line.parameter, pattern) for line in lines):
            raise ConfigError(f"`write`: {one_of('number', pattern, [line.parameter for line in lines])}")
    return [line for line in lines if any(fnmatchcase(line.parameter, pattern) for pattern in chosen)]


def _page(
    found: Audit,
    model: Path,
    record: Mapping[str, Any],
    origin: Mapping[str, Any],
    typed: Callable[[str], str],
) -> str:
    wrong = [line for line in found.lines if line.verdict == VERDICTS[0]]
    untold = [line for line in found.lines if line.verdict == VERDICTS[2]]
    judged = [line for line in found.lines if line not in untold]
    rest = Section(
        f"{len(untold)} numbers that these logs cannot tell", table=audit_table(untold), folded=True
    )
    statements = [
        Statement(
            "bad",
            f"The {line.what} of {line.of}: {line.file:.4g} in the file, {_said(line)} in the logs"
            f"{_factor(line)}.",
        )
        for line in wrong[: numbers.MOST_NAMES]
    ]
    statements += [Statement("bad", f"{text[0].upper()}{text[1:]}.") for text in map(typed, _against(found))]
    sections = [
        Section(
            "The numbers of the file",
            text=(_COLUMNS if judged else "These logs contradict no number of the file, and confirm none.")
            + "".join(f" {text[0].upper()}{text[1:]}." for text in _compared(found.found)),
            table=audit_table(judged) if judged else None,
        ),
        *[rest] * bool(untold),
        *[
            Section(
                "Estimated beside them",
                text="What no file says and the motion depends on, such as zeros and a delay.",
                table=beside_table(found.beside),
            )
        ]
        * bool(found.beside),
        *([missing_section(found.found.missing)] if found.found.missing else []),
        *([overlay_section(found.found.fits)] if found.found.fits else []),
    ]
    return result_page(
        record, origin, title=f"Audit of {model.name}", facts=(), headline=f"{count_text(found.lines)}.",
        statements=statements, sections=sections,
    )  # fmt: skip


def _said(line: Line) -> str:
    return numbers.quantity(numbers.with_sd(line.log, line.sd), line.unit)


def _factor(line: Line) -> str:
    """', 0.035 times that'."""
    return f", {line.log / line.file:.2g} times that" if line.file > 0.0 and line.log > 0.0 else ""


# -- two files -----------------------------------------------------------------------------------------------


def difference_table(found: FilesCompared, one: str, other: str) -> Table:
    """What two files disagree on."""
    rows = [
        (
            d.of,
            d.what,
            _values(d.one),
            _values(d.other),
            numbers.unit_of(d.unit),
            _times(d),
            numbers.percent(d.weight),
        )
        for d in found.differences
    ]
    return Table(
        ("part", "number", one, other, "unit", "times", "of forces"),
        ("", "", NUMBER, NUMBER, "", NUMBER, NUMBER),
        rows,
    )


def difference_text(found: FilesCompared, one: str, other: str) -> Iterator[str]:
    """What is said below the table."""
    yield f"numbers that differ: {len(found.differences)}; that are equal: {found.alike}"
    masses = [f"{mass:.4g} kg" for mass in found.masses]
    yield f"what moves weighs {masses[0]} in {one} and {masses[1]} in {other}"
    for name, alone in zip((one, other), found.alone, strict=True):
        if alone:
            yield f"only in {name}: {numbers.some(alone)}"


def difference_record(found: FilesCompared, one: Path, other: Path) -> dict[str, Any]:
    """The keys of `amhe audit A B --json`."""
    return plain({"models": [str(one), str(other)], **asdict(found)})


def _values(values: Sequence[float]) -> str:
    return " ".join(f"{value + 0.0:.4g}" for value in values)


def _times(d: FileDifference) -> str:
    sizes = [float(np.abs(values).max()) for values in (d.one, d.other)]
    return (
        f"{sizes[1] / sizes[0]:.2g}"
        if min(sizes) > 0.0 and d.what not in ("place", "range", "centre of mass")
        else ""
    )
