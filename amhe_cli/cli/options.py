"""Options that several commands share, in the words of one place.

where:  --system --topic --msg-path --from --to, of all that read logs
tuning: --set --config
work:   --seed --threads --engine
output: -o --force, of a folder; page: of a file

Besides these, a command has at most 16 options of its own; what is seldom needed is a setting.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from amhe_cli.cli import completion
from amhe_cli.cli.command import Option, argument, flag, in_panel, option, setting
from amhe_cli.cli.kinds import (
    COUNT,
    FILE,
    FOLDER,
    LOG,
    SECONDS,
    NewFile,
    Number,
    WholeNumber,
    episodes,
    listed,
    pairs,
)
from amhe_cli.cli.required import required
from amhe_cli.core.errors import ConfigError

#: Names of the tasks in robots/go1/tasks.py, which --help need not load.
TASKS = ("t1", "t2", "t3", "t4", "t5", "hw1", "hw2")
#: Likewise of the modes in robots/go1/run.py.
MODES = ("true", "baseline", "stale", "adaptive")
#: Likewise the longest run of a task [s].
LONGEST = 40.0

#: Headings of the help.
_DATA, _START, _SEARCH, _COMPUTING = "Logs and system", "What is known", "The estimator", "Computing"
_LISTENING, _SETTINGS, _OUTPUT = "Where messages come from", "Settings", "Output"


def task(about: str, default: str | None = "t1", more: tuple[str, ...] = ()) -> Option:
    """Whose box and floor."""
    return option("--task", about, (*TASKS, *more), default=default, show_default=bool(default))


def seconds(about: str, default: float | None = None, shown: Any = True, **bounds: Any) -> Option:
    """How long something goes on [s]; without a default: until it is stopped."""
    kind = Number(**({"min": 0, "min_open": True} | bounds))
    return option("--seconds", about, kind, default=default, show_default=shown)


#: How long a run may last.
duration = seconds("Stop each run after S seconds of it.", LONGEST, "40, the tasks' own limit", max=600)

#: What most commands read.
logs = argument("logs", LOG, nargs=-1, required=True, callback=episodes, metavar="LOG...")


def system_or(default: str) -> Option:
    """The system, and which it is where the user does not say."""
    return option(
        "--system NAME|DIR",
        f"A bundled system or your own system folder.  [default: {default}]",
        shell_complete=completion.systems,
    )


system = system_or("named by the log, or amhe.toml beside it")
msg_path = option(
    "--msg-path", "Folder of .msg files, for message types that the log does not define itself.", FOLDER
)
topics = option(
    "topics --topic SIGNAL=/name ...",
    "Read a signal of the system from another topic; repeat for more.",
    callback=pairs(str),
)
where = in_panel(
    _DATA,
    system,
    topics,
    msg_path,
    option("start --from", "Begin S seconds after the log's start.", Number(min=0)),
    option("end --to", "End S seconds after the log's start.", Number(min=0)),
)


def held_out(use: str) -> Option:
    """Logs that are not fitted; `use` says what for."""
    text = f"{use}; repeat for more.  [default: a quarter of the logs' time]"
    return option("--held-out ...", text, LOG, callback=episodes, panel=_DATA)


tuning = in_panel(
    _SETTINGS,
    option("assignments --set A.B=V ...", "Override a setting, such as clips.count=40; repeat for more."),
    option("--config", "YAML file of settings; --set wins.", FILE),
)


def _cores() -> int:
    """Cores that this process may use."""
    from amhe_cli.api.arguments import cores

    return cores()


def _known_engine(ctx: click.Context, param: click.Parameter, value: str) -> str:
    if value != "cpu":  # the default needs no look at the library, which is slow to load
        from amhe_cli.engine.open import check_kind

        try:
            check_kind(value)
        except ConfigError as error:
            raise click.BadParameter(str(error), ctx, param) from None
    return value


engine = option(
    "--engine KIND",
    "What computes the rollouts: cpu; gpu, with the extra [gpu] and a card; auto: for each call the quicker.",
    default="cpu",
    callback=_known_engine,
    panel=_COMPUTING,
)
seed = option("--seed", "Of the random numbers.", WholeNumber(min=0), default=0)
work = in_panel(
    _COMPUTING,
    seed,
    option(
        "--threads",
        "Results depend on the seed, never on this.",
        COUNT,
        default=_cores,
        show_default="all cores",
    ),
    engine,
)


def _spread(default: Any, shown: str) -> tuple[Option, ...]:
    return in_panel(
        _COMPUTING,
        option("--workers", "Processes on this machine.", COUNT, default=default, show_default=shown),
        option(
            "--cluster tcp://HOST:PORT",
            "A dask scheduler whose workers do it instead; needs the extra [cluster]. Whoever reaches its "
            "port can run any code as you (docs/scaling.md).",
        ),
    )


spread = _spread(_cores, "all cores")
spread_if_chosen = _spread(None, "none: threads of this one")


def require(of: str) -> Option:
    """How precisely parameters must be known."""
    return option(
        "--require 'NAME<5%' ...",
        f"Exit code 3 if {of} is larger than a share of its value; repeat for more.",
        callback=required,
    )


def force(of: str) -> Option:
    """What exists may be written over."""
    return flag("--force", f"Write {of}.", panel=_OUTPUT)


output = in_panel(
    _OUTPUT,
    option(
        "-o --out OUT",
        "Folder to write to.  [default: amhe-out/<command>-<date>-<time>/]",
        click.Path(path_type=Path),
    ),
    force("into an existing OUT that is not empty"),
)


def written(form: str, about: str) -> tuple[Option, ...]:
    """A file to write, called so in the help; see `Given.write_out`."""
    return in_panel(_OUTPUT, option("-o --out", about, NewFile(form)), force(f"over {form} where it exists"))


#: A page, or an object.
page = written("FILE.html", "Write it as a page, too; a FILE.json gets what --json prints.")

belief_anyway = flag(
    "--belief-anyway", "Take a belief about another model too, and only warn of what has changed."
)


def believed(about: str) -> tuple[Option, ...]:
    """A belief to start from, and whether it may be about another model."""
    return in_panel(_START, option("--belief", about, FILE), belief_anyway)


def _asked(ctx: click.Context, param: click.Parameter, given: str | None) -> str | None:
    names = listed(ctx, param, given)
    return f"[{', '.join(names)}]" if names else None


unknowns = setting(
    "unknowns GROUP|NAME,...",
    "What is estimated, where a system holds parameters: of go1_push box (the default), box_size, robot.",
    callback=_asked,
    panel=_START,
)
narrowing = in_panel(
    _START,
    option(
        "--fix NAME=VALUE ...",
        "Take a parameter as known; it is not estimated. Repeat for more.",
        shell_complete=completion.parameters("="),
        callback=pairs(float),
    ),
    option(
        "--only NAME,NAME ...",
        "Estimate these parameters (names, or patterns such as 'left_*') and fix all others.",
        shell_complete=completion.parameters(),
        callback=lambda ctx, param, given: list(listed(ctx, param, given)) or None,
    ),
    unknowns,
)


def _held(ctx: click.Context, param: click.Parameter, path: Path | None) -> dict[str, float] | None:
    if path is None:
        return None
    from amhe_cli.core.belief import Belief, held_by

    known = held_by(Belief.load(path))
    return {f"{name}.{key}": value for name, keys in known.items() for key, value in keys.items()}


robot = option(
    "--robot",
    "Belief of identify --unknowns robot: the robot's numbers are held at its values; what they leave open "
    "widens the intervals of the others.",
    FILE,
    setting="parameters",
    callback=_held,
    panel=_START,
)
max_time = option(
    "--max-time",
    "Take no longer: the best so far, without the checks that take too long.",
    SECONDS,
    panel=_COMPUTING,
)

method = setting(
    "mhe.method",
    "Update of the estimator: ours, or the paper's.  [default: linearised]",
    ("linearised", "logrank"),
)
#: The online estimator's settings that have options.
followed = in_panel(
    _SEARCH,
    setting(
        "match",
        "Compare the motion under what drives it, or the joints' efforts along it.  [default: the system's]",
        ("motion", "effort"),
    ),
)
estimator = in_panel(
    _SEARCH,
    method,
    setting(
        "mhe.window",
        "Time that one update looks back.  [default: 0.5; of go1_push 0.4, of efforts 1]",
        SECONDS,
    ),
    setting(
        "mhe.update_period",
        "Time between two updates.  [default: 0.2; of go1_push 0.1, of efforts 0.5]",
        SECONDS,
    ),
    setting(
        "mhe.samples B",
        "Rollouts of one iteration; linearised takes two for each unknown, or more, and one at the mean.  "
        "[default: 8 for linearised, 32 for logrank]",
        WholeNumber(min=4),
    ),
    setting(
        "mhe.iterations L",
        "Iterations of one update, at most.  [default: 3 for linearised, 4 for logrank; 1 for linearised "
        "where first states are taken as recorded, as for go1_push]",
        COUNT,
    ),
    setting(
        "mhe.learning_rate",
        "How far an iteration of logrank moves mean and variance.  [default: 0.5]",
        Number("A", min=0, min_open=True, max=1),
    ),
    setting(
        "mhe.prior_weight NAME=W ...",
        "How firmly a parameter is held at its last estimate; repeat for more.  [default: 0; of go1_push "
        "box_inertia_scale=30]",
        callback=pairs(float),
        shell_complete=completion.parameters("="),
    ),
)

#: Where messages of a running system come from.
listening = in_panel(
    _LISTENING,
    option(
        "--source SOURCE",
        "ros2; zenoh; mcap, with --follow; udp://HOST:PORT or - (stdin): lines of JSON; or a LOG, which is "
        "played.",
        required=True,
    ),
    option(
        "--follow FILE",
        "mcap: a file that a recorder still writes, or the folder that it writes to.",
        click.Path(path_type=Path),
    ),
    setting(
        "live.domain",
        "ros2, zenoh: ROS_DOMAIN_ID of the robot.  [default: ROS_DOMAIN_ID, or 0]",
        WholeNumber(0, 232),
        envvar="ROS_DOMAIN_ID",
    ),
    setting("live.peers ADDRESS,ADDRESS", "ros2: look for the robot at these addresses, without multicast."),
    setting("live.connect ENDPOINT", "zenoh: the router.  [default: tcp/localhost:7447]"),
)
