"""`amhe mhe-replay`: the online estimator over a log, as if it were live."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from amhe_cli.cli import options
from amhe_cli.cli.command import Given, argument, command
from amhe_cli.cli.kinds import LOG, one_episode
from amhe_cli.cli.session import Session, stopping

if TYPE_CHECKING:
    from amhe_cli.cli.progress import Shown
    from amhe_cli.estimation.online.horizon import Estimate
    from amhe_cli.estimation.online.replay import Replay

#: Parameters that a line has room for.
_SHOWN = 4


@command(
    "A log to parameters over time, as if live.",
    argument("log", LOG, required=False, callback=one_episode, metavar="[LOG]"),
    options.where,
    options.believed(
        "Start from a belief.yaml, its sd floored so that it can still move, instead of the system's prior."
    ),
    options.narrowing,
    options.followed,
    options.estimator,
    options.work,
    options.tuning,
    options.output,
    name="mhe-replay",
)
def mhe_replay(session: Session, given: Given) -> None:
    """Estimate parameters over the time of LOG, with the newest window at each update.

    LOG is an MCAP file, a rosbag2 folder, a ROS 1 bag, a table (CSV, npz, parquet and others), a ULog or
    an episode of a LeRobot dataset: see docs/logs.md. Without LOG a bundled one is replayed, of a Go1 that
    pushes a box onto another floor. Writes estimates.mcap, estimates.csv, result.json and report.html. With
    a longer --window, updates are further apart in proportion, unless their period is given, too.
    """
    from amhe_cli.cli.progress import progress
    from amhe_cli.core.bundled import bundled_logs
    from amhe_cli.estimation.online.replay import caution, open_replay, paced, predictions, replay_fits
    from amhe_cli.report.replay import print_replay, write_replay
    from amhe_cli.report.replay_files import replay_record
    from amhe_cli.system.provenance import estimator_provenance, inputs_record
    from amhe_cli.system.system import System

    folder, inputs, belief = given.reserve(), given.inputs, given.belief
    path = given.log or bundled_logs()["t4"]
    opened = inputs.open([path])
    chosen = inputs.overrides.all.get("mhe") or {}
    follows = "window" in chosen and "update_period" not in chosen
    if follows and opened.folder is not None:
        opened = paced(opened, System.load(opened.folder, warn=False).settings.mhe)
    opened, known = opened.starting_from(belief, **given.pick("fix", "only", "belief_anyway"))
    (recorded,) = inputs.read(opened, [path])
    replay = open_replay(
        opened, recorded, belief=known, seed=given.seed, threads=given.threads, kind=given.engine,
        begun=inputs.start or 0.0, paced=follows,
    )  # fmt: skip
    with stopping(session) as stopped:
        with progress(session, "mhe-replay", partial(_shown, replay)) as show:
            replay.run(show, stopped)
        caution(replay)
        session.interrupted = replay.interrupted
        predicted, fits = predictions(replay), replay_fits(replay)
        hashed = [path, *([belief] if belief else [])]
        method = replay.system.settings.mhe.method
        origin = estimator_provenance(session.command_line, given.seed, method, replay.system, hashed)
        record = session.record(
            **replay_record(replay), seed=given.seed, out=str(folder), provenance=origin,
            inputs=inputs_record(replay.system, [recorded]),
        )  # fmt: skip
        write_replay(folder, replay, predicted, fits, record, origin, given.force)
    if session.gave(record):
        return
    if replay.paced:
        mhe = replay.system.settings.mhe
        session.console().print(f"windows of {mhe.window:g} s, updates every {mhe.update_period:g} s")
    print_replay(record, folder, session.console())


def _shown(replay: Replay, estimate: Estimate) -> Shown:
    """'5.9 s: box_mass 4.15 ± 0.24, floor_friction 0.459 ± 0.021; jump'."""
    from amhe_cli.report.numbers import with_sd

    rows = list(zip(estimate.belief.names, estimate.theta, estimate.sd, strict=True))
    texts = [f"{name} {with_sd(float(value), float(sd))}" for name, value, sd in rows[:_SHOWN]]
    more = ", ..." if len(rows) > _SHOWN else ""
    last = replay.steps[-1]
    state = f"{estimate.time:.1f} s: {', '.join(texts)}{more}; {estimate.mark}"
    return state, estimate.time - replay.begun, last.stop * last.log.dt + 1e-9
