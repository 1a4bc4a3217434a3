"""The tables of a study: the paper's two, all measures, differences between modes, goals, ablations."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from typing import Any

from amhe_cli.report.numbers import MISSING
from amhe_cli.report.study.formats import StudyTable
from amhe_cli.study import paper
from amhe_cli.study.ablations import Ablation
from amhe_cli.study.estimates import BEGUN, NEAR, RESOLVED, SETTLED, estimates
from amhe_cli.study.goals import Goal
from amhe_cli.study.statistics import Spread
from amhe_cli.study.summary import MEASURES, RATES, Group, Groups, difference

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


def tables(groups: Groups, found: list[Ablation], judged: list[Goal]) -> list[StudyTable]:
    """All tables that have a row."""
    made = (
        table_1(groups),
        table_2(groups),
        measures(groups),
        differences(groups),
        goal_table(judged),
        estimate_table(groups),
        ablation_table(found),
    )
    return [table for table in made if table.rows]


def label(name: str) -> str:
    """Label of a measure with its unit: 'e_g [m]'."""
    sign, unit, _ = SIGNS[name]
    return sign if unit == "-" else f"{sign} [{unit}]"


def mean_sd(name: str, spread: Spread) -> str:
    """Mean and sd: '0.028 ± 0.005'; of a rate, percent."""
    return _with_sd(name, spread.mean, spread.sd)


def table_1(groups: Groups) -> StudyTable:
    """Like the paper's table I: T4."""
    task = paper.TABLE_1_TASK
    ours = groups.of(task)
    rows, records = [], []
    for name, theirs in paper.TABLE_1.items() if ours else ():
        published = [_with_sd(name, *theirs[mode]) for mode in paper.MODES]
        rows.append((label(name), *(mean_sd(name, group.spread(name)) for group in ours), *published))
        records += [_record(g, name) | _theirs(theirs.get(g.mode)) for g in ours]
    head = ("", *(_mode(group) for group in ours), *(f"paper: {mode}" for mode in paper.MODES.values()))
    note = "Our cost J is not the paper's: compare costs among our modes, or among the paper's."
    return StudyTable(
        "table1",
        f"{task.upper()}: mean ± sd over seeds, beside the paper's table I",
        head,
        rows,
        records,
        note,
    )


def table_2(groups: Groups) -> StudyTable:
    """Like the paper's table II: all tasks."""
    modes = groups.modes_of(groups.tasks)
    rows, records = [], []
    for (task, name), theirs in paper.TABLE_2.items():
        ours = {mode: group for mode in modes if (group := groups.get(task, mode)) and group.n}
        if ours:
            published = [_value(name, theirs[mode]) for mode in paper.MODES]
            mine = [mean_sd(name, ours[m].spread(name)) if m in ours else MISSING for m in modes]
            rows.append((f"{task.upper()} {label(name)}", *mine, *published))
            records += [_record(g, name) | {"paper_mean": theirs.get(m)} for m, g in ours.items()]
    head = ("", *modes, *(f"paper: {mode}" for mode in paper.MODES.values()))
    return StudyTable(
        "table2", "Speed error and final error, beside the paper's table II", head, rows, records
    )


def measures(groups: Groups) -> StudyTable:
    """All measures, at the operating point."""
    rows, records = [], []
    for group in groups.at_base():
        shown = [_rate(group.spread(name)) for name in ("success", "on_time")]
        shown.append(f"{int(group.values('fell').sum())}")
        for name in MEASURES:
            spread = group.spread(name)
            shown.append(f"{mean_sd(name, spread)} ({_value(name, spread.median)})")
        rows.append((f"{group.task} {group.mode}", str(group.n), *shown))
        records += [_record(group, name) for name in (*RATES, *MEASURES)]
    head = ("", "n", "S_R [%]", "S_T [%]", "falls", *(label(name) for name in MEASURES))
    note = (
        "S_R, S_T: with Wilson's 95 % interval. Others: mean ± sd (median). "
        "Bootstrap intervals of the means are in the CSV and JSON."
    )
    return StudyTable("measures", "All measures", head, rows, records, note)


def differences(groups: Groups) -> StudyTable:
    """Every mode against the true belief, on the same seeds."""
    rows, records = [], []
    for group in groups.at_base():
        true = groups.get(group.task, "true")
        if group.mode == "true" or not true or not true.n:
            continue
        found = {name: difference(group, true, name) for name in MEASURES}
        n = found["cost"].n
        if not n:
            continue
        shown = []
        for name, d in found.items():
            relative = name in ("cost", "time_s")
            numbers = (d.ratio, d.ratio_low, d.ratio_high) if relative else (d.mean, d.low, d.high)
            shown.append(_interval(*numbers, digits=1 if relative else SIGNS[name][2], percent=relative))
            records.append(
                {"task": group.task, "mode": group.mode, "against": "true", "measure": name} | asdict(d)
            )
        rows.append((f"{group.task} {group.mode}", str(n), *shown))
    head = (
        "", "n",
        *(f"{SIGNS[m][0]} [%]" if m in ("cost", "time_s") else label(m) for m in MEASURES),
    )  # fmt: skip
    note = (
        "Means of paired differences [95 % bootstrap interval]; J and t_exec in percent of the true mode's."
    )
    return StudyTable("differences", "Against the true belief, seed by seed", head, rows, records, note)


def goal_table(judged: list[Goal]) -> StudyTable:
    """The goals, and whether they are reached."""
    rows = []
    for goal in judged:
        sign, unit, digits = SIGNS[goal.measure]
        percent = goal.kind == "ratio" or unit == "%"
        digits = 1 if goal.kind == "ratio" else digits
        what = {"value": sign, "difference": f"{sign} − true's", "ratio": f"{sign} / true's − 1"}[goal.kind]
        shown = _interval(goal.value, goal.low, goal.high, digits, percent, signed=goal.kind != "value")
        bound = f"{'≥' if goal.at_least else '≤'} {_scaled(goal.limit, digits, percent)}"
        unit = "%" if percent else unit
        reached = "yes" if goal.reached else "NO"
        rows.append((f"{goal.task} {goal.mode}", str(goal.n), what, unit, shown, bound, reached))
    records = [asdict(goal) | {"reached": goal.reached} for goal in judged]
    head = ("", "n", "measure", "unit", "value [95 % interval]", "goal", "reached")
    return StudyTable("goals", "Goals", head, rows, records)


def estimate_table(groups: Groups) -> StudyTable:
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


def ablation_table(found: list[Ablation]) -> StudyTable:
    """Every value that was tried, with the operating point marked."""
    rows, records = [], []
    for ablation in found:
        for index, (value, group) in enumerate(zip(ablation.values, ablation.groups, strict=True)):
            mark = " *" if index == ablation.default else ""
            names = ("success", "goal_error_m", "speed_rmse", "cost", "time_s")
            shown = [mean_sd(name, group.spread(name)) for name in names]
            written = value if isinstance(value, str) else json.dumps(value)
            where = f"{ablation.path} ({ablation.task} {ablation.mode})"
            rows.append((where, f"{written}{mark}", str(group.n), *shown))
            common = {
                "setting": ablation.path,
                "value": written,
                "operating_point": index == ablation.default,
            }
            records += [common | _record(group, name) for name in (*RATES, *MEASURES)]
    head = (
        "",
        "value",
        "n",
        *(label(m) for m in ("success", "goal_error_m", "speed_rmse", "cost", "time_s")),
    )
    return StudyTable(
        "ablations", "Ablations", head, rows, records, "* the operating point; mean ± sd over seeds."
    )


def _mode(group: Group) -> str:
    return f"{group.mode} (n = {group.n})"


def _record(group: Group, name: str) -> dict[str, Any]:
    return {"task": group.task, "mode": group.mode, "measure": name} | asdict(group.spread(name))


def _theirs(value: tuple[float, float] | None) -> dict[str, Any]:
    mean, sd = value or (None, None)
    return {"paper_mean": mean, "paper_sd": sd}


def _scaled(value: float, digits: int, percent: bool) -> str:
    return MISSING if not math.isfinite(value) else f"{(100.0 if percent else 1.0) * value:.{digits}f}"


def _value(name: str, value: float) -> str:
    _, unit, digits = SIGNS[name]
    return _scaled(value, digits, unit == "%")


def _with_sd(name: str, mean: float, sd: float) -> str:
    return f"{_value(name, mean)} ± {_value(name, sd)}" if math.isfinite(sd) else _value(name, mean)


def _rate(spread: Spread) -> str:
    return (
        f"{_scaled(spread.mean, 0, True)} [{_scaled(spread.low, 0, True)}, {_scaled(spread.high, 0, True)}]"
    )


def _interval(value: float, low: float, high: float, digits: int, percent: bool, signed: bool = True) -> str:
    factor, sign = 100.0 if percent else 1.0, "+" if signed else ""
    if not math.isfinite(value):
        return MISSING
    shown = f"{factor * value:{sign}.{digits}f}"
    if not math.isfinite(low):
        return shown
    return f"{shown} [{factor * low:{sign}.{digits}f}, {factor * high:{sign}.{digits}f}]"
