"""Which figures a study has."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias

from matplotlib.figure import Figure

from amhe_cli.report.study.ablation import ablation_figure
from amhe_cli.report.study.curves import cost_figure, parameter_figure, speed_figure
from amhe_cli.report.study.drawing import Drawing, StudyTask
from amhe_cli.report.study.paths import one_leg_figure, path_figure
from amhe_cli.study.ablations import Ablation
from amhe_cli.study.summary import Groups

_Draw: TypeAlias = Callable[[Groups, Sequence[StudyTask]], Figure]
#: Figures of several tasks: name, title, caption, the tasks (none named: all), what draws it.
_FIGURES: tuple[tuple[str, str, str, tuple[str, ...], _Draw], ...] = (
    (
        "paths", "Paths of the box",
        "Every seed; the cross is the goal. Distances beside the straight paths are stretched.",
        ("t1", "t2", "t3"), path_figure,
    ),
    (
        "speed", "Tracking of the forward speed",
        "Speed of the trunk in its own heading, averaged over 0.2 s; mean and sd over the seeds, as long as "
        "half of them are running.",
        (), speed_figure,
    ),
    (
        "costs", "Density of the running cost",
        "Over all states of all seeds, each 0.2 s. The cost rises by orders of magnitude when a push fails, "
        "hence the logarithm.",
        ("t2", "t3"), cost_figure,
    ),
    (
        "parameters", "Parameters over time",
        "Belief, mean and sd over the seeds, against the truth; time from the change of box or floor on. "
        "A steady push shows mu m; mu and m by themselves show only while the speed changes.",
        ("t3", "t4"), parameter_figure,
    ),
)  # fmt: skip


def drawings(groups: Groups, tried: Sequence[Ablation], tasks: Mapping[str, StudyTask]) -> list[Drawing]:
    """The figures that have something to show.

    Args:
        groups: Groups of the study.
        tried: Ablations of the study.
        tasks: All tasks.
    """
    made = []
    for name, title, caption, wanted, draw in _FIGURES:
        shown = [tasks[task] for task in groups.tasks if task in (wanted or groups.tasks) and task in tasks]
        if name == "parameters":  # in mode true, beliefs are the truth
            shown = [task for task in shown if set(groups.modes_of([task.name])) - {"true"}]
        if shown:
            made.append(Drawing(name, title, caption, lambda d=draw, s=shown: d(groups, s)))
    for task in (tasks[name] for name in groups.tasks if name in tasks and tasks[name].floor.one_leg):
        caption = (
            "From above: trunk and box at the start (dotted) and the end, the goal (dashed), and the way of "
            "the foot that pushes, of seed 0. Thin: the box of the other seeds."
        )
        title = f"{task.name.upper()}: final configuration"
        made.append(Drawing("final", title, caption, lambda t=task: one_leg_figure(groups, t)))
    if tried:
        caption = (
            "One setting is changed at a time. Solid: cost J, mean and sd over seeds; dotted: success with "
            "Wilson's 95 % interval; dashed: the operating point."
        )
        made.append(Drawing("ablations", "Ablations", caption, lambda: ablation_figure(tried)))
    return made
