"""The tables of a study, for people and as Markdown, LaTeX and CSV; two of them are like the paper's."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from amhe_cli.core.errors import printable
from amhe_cli.core.files import plain
from amhe_cli.report.numbers import MISSING
from amhe_cli.report.tables import NUMBER, Table
from amhe_cli.study.goals import (
    BEGUN,
    NEAR,
    PAPER_MODES,
    RESOLVED,
    SETTLED,
    TABLE_1,
    TABLE_1_TASK,
    TABLE_2,
    Goal,
    estimates,
)
from amhe_cli.study.summary import MEASURES, RATES, Ablation, Group, Groups, Spread, difference

#: Characters with a special meaning in LaTeX, and how they are written.
_LATEX = {
    "\\": r"\textbackslash{}", "%": r"\%", "_": r"\_", "&": r"\&", "#": r"\#", "$": r"\$",
    "±": r"$\pm$", "≤": r"$\le$", "≥": r"$\ge$", "–": "--", "×": r"$\times$", "−": "$-$",
}  # fmt: skip
#: What Markdown takes for markup; an underscore within a word is none, nor are brackets without a link.
_MARKUP = re.compile(r"[\\|<&`*~]|(?<=\])[(\[:]|(?<![^\W_])_|_(?![^\W_])")


@dataclass(frozen=True, slots=True)
class StudyTable:
    """Text for people, numbers for programs.

    Args:
        name: Name of its files.
        title: Title of the table.
        head: Headings of the columns.
        rows: Rows, with one text for each column.
        records: The same content as numbers, in long form.
        note: What a reader should know.
    """

    name: str
    title: str
    head: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    records: Sequence[Mapping[str, Any]]
    note: str = ""

    @property
    def table(self) -> Table:
        """Its rows."""
        return Table(self.head, ("", *(NUMBER for _ in self.head[1:])), self.rows)


def markdown(table: StudyTable) -> str:
    """The table for GitHub."""
    lines = [table.head, ("---", *["---:"] * (len(table.head) - 1)), *table.rows]
    body = ["| " + " | ".join(map(_unmarked, line)) + " |" for line in lines]
    title, note = _unmarked(table.title), _unmarked(table.note)
    return "\n".join((f"**{title}**", "", *body, *(["", note] if note else []))) + "\n"


def latex(table: StudyTable) -> str:
    """The table for a LaTeX paper that loads booktabs."""
    head, *lines = (" & ".join(map(_escaped, line)) + r" \\" for line in (table.head, *table.rows))
    rows = "\n    ".join((r"\toprule", head, r"\midrule", *lines, r"\bottomrule"))
    return rf"""\begin{{table}}[htbp]
  \centering
  \caption{{{_escaped(table.title)}}}
  \label{{tab:{table.name}}}
  \begin{{tabular}}{{@{{}}l{"r" * (len(table.head) - 1)}@{{}}}}
    {rows}
  \end{{tabular}}
\end{{table}}
"""


def comma_separated(table: StudyTable) -> str:
    """The table as CSV, one row for each record."""
    out = io.StringIO()
    names = list(dict.fromkeys(name for record in table.records for name in record))
    writer = csv.DictWriter(out, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(plain(record) for record in table.records)
    return out.getvalue()


#: Suffix of a file -> what makes its content.
FORMATS = {"md": markdown, "tex": latex, "csv": comma_separated}


def _unmarked(words: str) -> str:
    """A text that Markdown shows as it is, in one line."""
    return _MARKUP.sub(r"\\\g<0>", printable(words))


def _escaped(words: str) -> str:
    return re.sub("|".join(map(re.escape, _LATEX)), lambda found: _LATEX[found[0]], words)


#: Measure -> its sign in the paper, its unit, and the decimals that its spread leaves meaningful.
SIGNS: dict[str, tuple[str, str, int]] = {
    "success": ("S_R", "%", 0),
    "on_time": ("S_T", "%", 0),
    "fell": ("falls", "%", 0),
    "goal_error_m": ("e_g", "m", 3),
    "speed_rmse": ("RMSE", "m/s", 3),
    "cost": ("J", "-", 0),
    "time_s": ("t_exec", "s", 1),
    "path_rmse_m": ("path rms", "m", 3),
}
#: Measures whose differences are shares of the true mode's.
_RELATIVE = ("cost", "time_s")
#: Measures of the table of ablations.
_ABLATED = ("success", "goal_error_m", "speed_rmse", "cost", "time_s")
_PAPERS = tuple(f"paper: {mode}" for mode in PAPER_MODES.values())


def tables(groups: Groups, found: Sequence[Ablation], judged: Sequence[Goal]) -> list[StudyTable]:
    """All tables that have a row."""
    made = (
        _table_1(groups), _table_2(groups), _measures(groups), _differences(groups), _goals(judged),
        _estimates(groups), _ablations(found),
    )  # fmt: skip
    return [table for table in made if table.rows]


def _table_1(groups: Groups) -> StudyTable:
    """Like the paper's table I: T4."""
    ours = groups.of(TABLE_1_TASK)
    rows, records = [], []
    for name, theirs in TABLE_1.items() if ours else ():
        published = [_mean_sd(name, *theirs[mode]) for mode in PAPER_MODES]
        rows.append((_label(name), *(_spread(group, name) for group in ours), *published))
        for group in ours:
            mean, sd = theirs.get(group.mode, (None, None))
            records.append(_record(group, name) | {"paper_mean": mean, "paper_sd": sd})
    return StudyTable(
        "table1", f"{TABLE_1_TASK.upper()}: mean ± sd over seeds, beside the paper's table I",
        ("", *(f"{group.mode} (n = {group.n})" for group in ours), *_PAPERS), rows, records,
        "Our cost J is not the paper's: compare costs among our modes, or among the paper's.",
    )  # fmt: skip


def _table_2(groups: Groups) -> StudyTable:
    """Like the paper's table II: all tasks."""
    modes = groups.modes_of(groups.tasks)
    rows, records = [], []
    for (task, name), theirs in TABLE_2.items():
        ours = {group.mode: group for group in groups.of(task)}
        if ours:
            mine = [_spread(ours[mode], name) if mode in ours else MISSING for mode in modes]
            published = [_value(name, theirs[mode]) for mode in PAPER_MODES]
            rows.append((f"{task.upper()} {_label(name)}", *mine, *published))
            records += [_record(g, name) | {"paper_mean": theirs.get(mode)} for mode, g in ours.items()]
    title = "Speed error and final error, beside the paper's table II"
    return StudyTable("table2", title, ("", *modes, *_PAPERS), rows, records)


def _measures(groups: Groups) -> StudyTable:
    """All measures, at the operating point."""
    rows = [
        (
            f"{group.task} {group.mode}", str(group.n),
            *(_interval(s.mean, s.low, s.high, 0, True, "") for s in map(group.spread, RATES[:2])),
            f"{int(group.values('fell').sum())}",
            *(f"{_spread(group, name)} ({_value(name, group.spread(name).median)})" for name in MEASURES),
        )
        for group in groups.at_base()
    ]  # fmt: skip
    records = [_record(group, name) for group in groups.at_base() for name in (*RATES, *MEASURES)]
    head = ("", "n", "S_R [%]", "S_T [%]", "falls", *map(_label, MEASURES))
    note = (
        "S_R, S_T: with Wilson's 95 % interval. Others: mean ± sd (median). "
        "Bootstrap intervals of the means are in the CSV."
    )
    return StudyTable("measures", "All measures", head, rows, records, note)


def _differences(groups: Groups) -> StudyTable:
    """Every mode against the true belief, on the same seeds."""
    rows, records = [], []
    for group in groups.at_base():
        true = groups.get(group.task, "true")
        if group.mode == "true" or not true or not difference(group, true, "cost").n:
            continue
        found = {name: difference(group, true, name) for name in MEASURES}
        shown = [
            _interval(d.ratio, d.ratio_low, d.ratio_high, 1, True)
            if name in _RELATIVE
            else _interval(d.mean, d.low, d.high, SIGNS[name][2])
            for name, d in found.items()
        ]
        rows.append((f"{group.task} {group.mode}", str(found["cost"].n), *shown))
        of = {"task": group.task, "mode": group.mode, "against": "true"}
        records += [of | {"measure": name} | asdict(d) for name, d in found.items()]
    head = ("", "n", *(f"{SIGNS[m][0]} [%]" if m in _RELATIVE else _label(m) for m in MEASURES))
    note = (
        "Means of paired differences [95 % bootstrap interval]; J and t_exec in percent of the true mode's."
    )
    return StudyTable("differences", "Against the true belief, seed by seed", head, rows, records, note)


def _goals(judged: Sequence[Goal]) -> StudyTable:
    """The goals, and whether they are reached."""
    rows = []
    for goal in judged:
        sign, unit, digits = SIGNS[goal.measure]
        what = {"value": sign, "difference": f"{sign} − true's", "ratio": f"{sign} / true's − 1"}[goal.kind]
        if goal.kind == "ratio":
            unit, digits = "%", 1
        percent, plus = unit == "%", "" if goal.kind == "value" else "+"
        shown = _interval(goal.value, goal.low, goal.high, digits, percent, plus)
        bound = f"{'≥' if goal.at_least else '≤'} {_scaled(goal.limit, digits, percent)}"
        reached = "yes" if goal.reached else "NO"
        rows.append((f"{goal.task} {goal.mode}", str(goal.n), what, unit, shown, bound, reached))
    records = [asdict(goal) | {"reached": goal.reached} for goal in judged]
    head = ("", "n", "measure", "unit", "value [95 % interval]", "goal", "reached")
    return StudyTable("goals", "Goals", head, rows, records)


def _estimates(groups: Groups) -> StudyTable:
    """Accuracy of the online estimates."""
    found = [accuracy for group in groups.at_base() if (accuracy := estimates(group))]
    rows = [
        (
            f"{e.task} {e.mode}", str(e.n),
            *(f"{100 * share:.1f}" for share in (e.product, e.mass, e.friction)),
            *(f"{100 * share:.0f}" for share in (e.mass_held, e.friction_held)),
            f"{round(e.resolved * e.n)} of {e.n}",
        )
        for e in found
    ]  # fmt: skip
    head = (
        "", "n", "mu m, rms [%]", "m, rms [%]", "mu, rms [%]", "m held [%]", "mu held [%]",
        f"resolved after {RESOLVED:g} s",
    )  # fmt: skip
    note = (
        f"Relative errors, and how often the 90 % interval holds the truth, from {SETTLED:g} s after the "
        f"change on; where nothing changes, from {BEGUN:g} s on. "
        f"Resolved: m and mu each within {100 * NEAR:.0f} % of the truth, or their interval holds it."
    )
    return StudyTable("estimates", "Online estimates", head, rows, [asdict(e) for e in found], note)


def _ablations(found: Sequence[Ablation]) -> StudyTable:
    """Every value that was tried, with the operating point marked."""
    rows, records = [], []
    for ablation in found:
        where = f"{ablation.path} ({ablation.task} {ablation.mode})"
        for index, (value, group) in enumerate(zip(ablation.values, ablation.groups, strict=True)):
            default, written = index == ablation.default, words_of(value)
            shown = [_spread(group, name) for name in _ABLATED]
            rows.append((where, f"{written}{' *' if default else ''}", str(group.n), *shown))
            of = {"setting": ablation.path, "value": written, "operating_point": default}
            records += [of | _record(group, name) for name in (*RATES, *MEASURES)]
    head = ("", "value", "n", *map(_label, _ABLATED))
    note = "* the operating point; mean ± sd over seeds."
    return StudyTable("ablations", "Ablations", head, rows, records, note)


def words_of(value: Any) -> str:
    """The value of a setting, as it is shown."""
    return value if isinstance(value, str) else json.dumps(value)


def _label(name: str) -> str:
    """A measure with its unit: 'e_g [m]'."""
    sign, unit, _ = SIGNS[name]
    return sign if unit == "-" else f"{sign} [{unit}]"


def _record(group: Group, name: str) -> dict[str, Any]:
    return {"task": group.task, "mode": group.mode, "measure": name} | asdict(group.spread(name))


def _spread(group: Group, name: str) -> str:
    """Mean and sd: '0.028 ± 0.005'; of a rate, percent."""
    spread: Spread = group.spread(name)
    return _mean_sd(name, spread.mean, spread.sd)


def _mean_sd(name: str, mean: float, sd: float) -> str:
    return f"{_value(name, mean)} ± {_value(name, sd)}" if math.isfinite(sd) else _value(name, mean)


def _value(name: str, value: float) -> str:
    _, unit, digits = SIGNS[name]
    return _scaled(value, digits, unit == "%")


def _scaled(value: float, digits: int, percent: bool, plus: str = "") -> str:
    return MISSING if not math.isfinite(value) else f"{(100.0 if percent else 1.0) * value:{plus}.{digits}f}"


def _interval(
    value: float, low: float, high: float, digits: int, percent: bool = False, plus: str = "+"
) -> str:
    """A number and its interval: '+3.0 [+1.2, +4.8]'."""
    shown, *ends = (_scaled(one, digits, percent, plus) for one in (value, low, high))
    return f"{shown} [{', '.join(ends)}]" if math.isfinite(low) else shown
