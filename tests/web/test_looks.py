"""Every kind of page in a real browser, wide and narrow, light and dark: nothing that a reader stumbles over.

The picture of a page with a fault (with PICTURES=all in the environment, of every page) stays in the folder
of the test, as PAGE-WIDTH-THEME.png.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.cli.main import run
from amhe_cli.core.log import Window
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.online.horizon import MovingHorizon
from amhe_cli.report.study.figures import drawn
from amhe_cli.report.study.page import study_page
from amhe_cli.report.study.tables import tables
from amhe_cli.robots.go1.tasks import TASKS
from amhe_cli.study.cells import Cell, setting_of
from amhe_cli.study.goals import goals
from amhe_cli.study.store import Study
from amhe_cli.study.summary import Groups, ablations
from amhe_cli.view.live import WindowsShown
from tests.cli.test_audit import spoilt
from tests.report.synthetic import identification
from tests.report.test_identification import page as report_of
from tests.study.cells_at_play import result
from tests.view.browser import Browser, Chromium

ROOT = Path(__file__).parents[2]
FAULTS = Path(__file__).with_name("faults.js").read_text(encoding="utf-8")
#: A browser's `open` of a page is followed by this: everything is unfolded, drawn and in its last colours.
SETTLED = """(async () => {
  for (const one of document.querySelectorAll('details')) one.open = true;
  for (let i = 0; i < 4; i++) await new Promise((done) => requestAnimationFrame(() => setTimeout(done, 40)));
  for (const one of document.getAnimations()) if (one instanceof CSSTransition) one.finish();
})()"""
QUICK = {"clips": {"count": 6}, "identify": {"iterations": 3, "first_state": "never"}}

#: A folder -> where pages are, in that folder or on a server, for as long as they are there.
Maker = Callable[[Path], AbstractContextManager[Sequence[str]]]


def of_commands(pages: str, *commands: str) -> Maker:
    """Pages that commands write; OUT in them is the folder."""

    @contextmanager
    def made(folder: Path) -> Iterator[Sequence[str]]:
        for command in commands:
            words = [word.replace("OUT", str(folder)) for word in command.split()]
            assert run([*words, "-q"]) == 0, words
        yield pages.split()

    return made


@contextmanager
def study(folder: Path) -> Iterator[Sequence[str]]:
    """The page of `amhe eval`, of runs that did not happen."""
    worse, modes = {"true": 0.0, "baseline": 1.0, "adaptive": 0.03}, ("true", "baseline", "adaptive")
    cells = [Cell(task, mode, seed) for task in ("t1", "t4", "t5") for mode in modes for seed in range(3)]
    cells += [Cell("t4", "adaptive", seed, setting_of({"control.samples": 16})) for seed in range(2)]
    groups = Groups([result(cell, worse[cell.mode]) for cell in cells], (), tuple(TASKS), modes)
    tried, floors = ablations(groups, {"control.samples": 8}), {n: task.floor for n, task in TASKS.items()}
    failed = {"t1 adaptive 3": "SimulationError: the plant diverged"}
    shown = drawn(groups, tried, floors)
    page = study_page(Study({}, {}, machine={}), groups, failed, tables(groups, tried, goals(groups)), shown)
    (folder / "report.html").write_text(page, encoding="utf-8")
    yield ["report.html"]


@contextmanager
def compare(folder: Path) -> Iterator[Sequence[str]]:
    """The page of `amhe compare`, of two models."""
    free = amhe.System.load("pendulum", QUICK)
    systems = [free, free.fixing({"damping": 0.4})]
    logs = [[amhe.read_log("example:pendulum", one, end=4.0)] for one in systems]
    amhe.compare(systems, logs).save(folder / "o")
    yield ["o/report.html"]


@contextmanager
def audit(folder: Path) -> Iterator[Sequence[str]]:
    """The page of `amhe audit`, of a file with numbers that a log contradicts."""
    model, log = spoilt(folder)
    assert run(["audit", str(model), str(log), "-o", str(folder / "o"), "-q"]) == 0
    yield ["o/report.html"]


@contextmanager
def watch(_: Path) -> Iterator[Sequence[str]]:
    """The page of `amhe watch --view`, with two windows of a log."""
    system = amhe.System.load("pendulum")
    log = amhe.read_log("example:pendulum", system)
    first, estimator = (
        system.space.nominal,
        MovingHorizon(system, open_engine(system), np.random.default_rng(0)),
    )
    with WindowsShown(system, first, "a log") as shown:
        for start in (1000, 1250):
            window = Window(log, start, round(0.5 / log.dt))
            end = window.stop * log.dt
            shown.put((window, replace(estimator.update(window, end), mark="jump" if start > 1000 else "")))
        yield [shown.server.address]


@contextmanager
def notebook(folder: Path) -> Iterator[Sequence[str]]:
    """What cells of a notebook show of a system, a log, a belief and a result."""
    system = amhe.System.load("pendulum", QUICK)
    log = amhe.read_log("example:pendulum", system)
    found = amhe.identify(system, [log])
    cells = "".join(one._repr_html_() for one in (found, system, log, found.belief))
    style = (
        "<style>body{background:light-dark(#fff,#111);color:light-dark(#222,#ddd);color-scheme:light dark}"
    )
    (folder / "notebook.html").write_text(f"<!doctype html>{style}</style>{cells}", encoding="utf-8")
    yield ["notebook.html"]


@contextmanager
def verdicts(folder: Path) -> Iterator[Sequence[str]]:
    """The report of a result with one of every verdict."""
    page = report_of(identification(), ("a gap of 0.6 s",))
    (folder / "report.html").write_text(page, encoding="utf-8")
    yield ["report.html"]


@contextmanager
def served(folder: Path) -> Iterator[Sequence[str]]:
    """Pages of the documentation, from a server."""
    serves = partial(SimpleHTTPRequestHandler, directory=folder)
    with ThreadingHTTPServer(("127.0.0.1", 0), serves) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}"
        yield [f"{address}/{name}.html" for name in ("index", "tutorial", "verdicts", "results", "view")]
        server.shutdown()


#: What makes pages -> how.
KINDS: dict[str, Maker] = {
    "identify": of_commands(
        "report.html view.html",
        "identify example:pendulum --set clips.count=6 --set identify.iterations=3 -o OUT",
    ),
    "verdicts": verdicts,
    "efforts": of_commands(
        "o/report.html o/view.html",
        "init example:arm_torque example:arm_torque -o OUT/system",
        "identify example:arm_torque --system OUT/system -o OUT/o",
    ),
    "mhe-replay": of_commands(
        "report.html view.html", "mhe-replay example:pendulum -o OUT", "view OUT -o OUT/view.html"
    ),
    "run": of_commands(
        "report.html", "run --task t4 --set control.samples=5 --set control.horizon=8 --seconds 1.5 -o OUT"
    ),
    "probe": of_commands(
        "report.html", "probe --system pendulum --seconds 3 --set probe.candidates=4 -o OUT"
    ),
    "compare": compare,
    "audit": audit,
    "check": of_commands(
        "model.html log.html",
        "check example:arm -o OUT/model.html",
        "check example:arm_torque example:arm_torque -o OUT/log.html",
    ),
    "explain": of_commands(
        "causes.html",
        "identify example:pendulum --only load_mass,*damping -o OUT/lie",
        "explain OUT/lie -o OUT/causes.html",
    ),
    "eval": study,
    "watch": watch,
    "notebook": notebook,
    "site": served,
}


def views(pages: Sequence[str]) -> Iterator[tuple[str, int, bool]]:
    """Each page wide and narrow, light and dark, in two views; of pages side by side, the other way round."""
    for number, page in enumerate(pages):
        yield from ((page, width, (width == 390) != number % 2) for width in (1280, 390))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_nothing_to_stumble_over(
    kind: str, chromium: Chromium, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    with KINDS[kind](request.getfixturevalue("site") if kind == "site" else tmp_path) as pages:
        for page, width, dark in views(pages):
            name = (
                f"{Path(page).stem if page.endswith('.html') else kind}-{width}-{'dark' if dark else 'light'}"
            )
            with chromium.tab(tmp_path) as tab:  # a new reader's: colours are remembered
                tab.open(page if "://" in page else (tmp_path / page).as_uri(), width, 900, dark)
                tab.run(SETTLED)
                until = time.monotonic() + 10.0
                while time.monotonic() < until:  # a script may choose the colours, on a busy machine late
                    back = re.findall(r"\d+", tab.run("getComputedStyle(document.body).backgroundColor"))
                    if (int(back[0]) < 128) is dark:
                        break
                    tab.run(SETTLED)
                found = [*tab.run(FAULTS), *tab.complaints]
                found += [f"the background is {back}"] * ((int(back[0]) < 128) is not dark)
                if found or "PICTURES" in os.environ:
                    tab.picture(tmp_path / f"{name}.png", whole=True)
            assert found == [], f"see {tmp_path / name}.png"


PLAIN = "<!doctype html><style>body {{ margin: 0; font: 16px sans-serif; background: #fff }}</style><p>{}</p>"
#: A page with a fault -> what is said of it.
WRONG = {
    "all is well": "",
    "<span style='color:#999'>pale</span>": "contrast 2.8: pale",
    "<span style='opacity:.5'>faint</span>": "contrast 4.0: faint",
    "<div style='width:900px'>wide</div>": "wider than the window: 900 of 390 px",
    "<b style='position:absolute;top:0'>one</b><b style='position:absolute;top:2px'>two</b>": (
        "on each other: one | two"
    ),
    "<p style='width:20px;overflow:hidden;white-space:nowrap'>cut here</p>": "cut off: cut here",
    "<svg width=50 height=20><text x=30 y=15>tick</text></svg>": "outside its figure: tick",
    "<figure class=plots></figure>": "an empty figure: plots",
    "<div class=panel><svg><path d=''></svg>speed</div>": "an empty panel: speed",
    "<canvas></canvas><script>document.querySelector('canvas').getContext('2d')</script>": "an empty scene: ",
    "<script>setTimeout(() => nothing(), 0)</script>": "ReferenceError: nothing is not defined",
}


@pytest.mark.medium
def test_each_fault_is_seen(tab: Browser, tmp_path: Path) -> None:
    for html, told in WRONG.items():
        (tmp_path / "wrong.html").write_text(PLAIN.format(html), encoding="utf-8")
        tab.complaints.clear()
        tab.open((tmp_path / "wrong.html").as_uri(), 390)
        tab.run(SETTLED)
        found = [*tab.run(FAULTS), *(line.partition("\n")[0] for line in tab.complaints)]
        assert found == ([told] if told else []), html
