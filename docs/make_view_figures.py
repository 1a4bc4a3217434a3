"""Make the pictures of docs/view.md: `python docs/make_view_figures.py`, in a clone with Chromium.

It identifies, replays and runs what the pictures show, in some two minutes, and takes the pages' pictures.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import amhe_cli as amhe
from amhe_cli.core.belief import belief_of
from amhe_cli.core.shown import SavedView
from amhe_cli.logs import read_metadata

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS.parent))
from tests.view.browser import Browser, browser  # noqa: E402

#: Chooses a clip, and a share of its time.
CLIP = (
    "const take = player.takes[{}]; player.choose(take); "
    "player.seek(take.start + {} * (take.stop - take.start))"
)
#: Leaves one section of a report.
ALONE = (
    "document.body.replaceChildren(document.getElementById('{}')); document.body.style.padding = '0 24px'; "
    "document.querySelector('section').style.margin = 0"
)
#: Picture -> page, width, height, and what is done on the page before.
PICTURES = {
    "push": ("run", 1280, 900, "player.seek(7.4)"),
    "result": ("found", 1280, 990, CLIP.format(0, 0.8)),
    "distance": (
        "t1",
        1280,
        1000,
        f"{CLIP.format(0, 0.9)}; document.getElementById('distance').click()",
    ),
    "whole": ("replay", 1280, 900, "player.next(); player.next()"),
    "tool": ("pusher", 1280, 960, CLIP.format(0, 0.8)),
}


def main() -> None:
    """Take all pictures."""
    with TemporaryDirectory(ignore_cleanup_errors=True) as scratch, browser(Path(scratch)) as one:
        folder = Path(scratch)
        command("identify", "example:pendulum", "-o", folder / "found")
        command("run", "--task", "t4", "--seconds", "9", "-o", folder / "run")
        command("mhe-replay", "example:t4", "-o", folder / "replay")
        one.open((folder / "replay" / "report.html").as_uri(), 1180, 310)
        take(one, "replay", ALONE.format("estimates"))
        for name in ("found", "run", "replay"):
            command("view", folder / name, "-o", folder / f"{name}.html")
        for name in ("t1", "pusher"):
            true_ghost(name).save(folder / f"{name}.html")
        for picture, (page, width, height, script) in PICTURES.items():
            one.open((folder / f"{page}.html").as_uri(), width, height)
            take(one, picture, script)
        with watched("run", "--task", "t4", "-o", folder / "live") as process:
            line = next(line for line in process.stderr or () if "http://" in line)
            one.open("http://" + line.partition("http://")[2].partition(";")[0], 1280, 900)
            three = "const wait = () => player.now > 3 ? done() : setTimeout(wait, 20); wait();"
            one.run(f"new Promise((done) => {{ {three} }})")
            take(one, "live", "")
            process.terminate()


def command(*arguments: str | Path) -> None:
    """Run a command of amhe."""
    subprocess.run([sys.executable, "-m", "amhe_cli", *map(str, arguments)], check=True)


def watched(*arguments: str | Path) -> subprocess.Popen[str]:
    """Start a command with a live page."""
    words = [sys.executable, "-m", "amhe_cli", *map(str, arguments), "--view"]
    return subprocess.Popen(words, stderr=subprocess.PIPE, text=True)


def true_ghost(name: str) -> SavedView:
    """The page of a bundled log with the ghost of its true parameters."""
    path = DOCS.parent / "examples" / "logs" / f"{name}.mcap"
    about = read_metadata(path)
    system = amhe.System.load(about["system"])
    known = system.space.named(system.space.nominal) | json.loads(about["truth"])
    z = system.space.z_of(np.array([known[name] for name in system.space.names]))
    return amhe.show(system, amhe.read_log(path, system), belief_of(system, z, 1e-4 * np.eye(len(z))))


def take(one: Browser, picture: str, script: str) -> None:
    """Do something on the open page, and take its picture."""
    one.run(f"(() => {{ {script} }})()")
    one.run("new Promise((done) => setTimeout(done, 500))")
    path = one.picture(DOCS / "figures" / "view" / f"{picture}.webp")
    print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
