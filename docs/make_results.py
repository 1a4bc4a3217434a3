"""Fill docs/results.md from the stored studies of docs/results/: `make results-report`, with Chromium.

A study is a folder that `amhe eval -o docs/results/NAME` wrote. Its result files are packed into one file,
`cells.zip`, and kept; all else is made of them. To add runs, unpack it first:
`python -m zipfile -e cells.zip cells`.
Between `<!-- results NAME/TABLE -->` and `<!-- end -->` stands that table; /figures are its figures, /missed
the goals that it misses, /made is what it was made with.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from zipfile import ZIP_LZMA, ZipFile, ZipInfo

from amhe_cli.report.study.page import write_study
from amhe_cli.robots.go1.run import MODES
from amhe_cli.robots.go1.tasks import TASKS
from amhe_cli.study.store import CELLS, Store, open_store

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS.parent))
from tests.view.browser import browser  # noqa: E402

STUDIES, PACKED = DOCS / "results", "cells.zip"
PAGE = DOCS / "results.md"
BLOCK = re.compile(r"<!-- results (?P<study>[\w-]+)/(?P<what>\w+) -->\n.*?<!-- end -->", re.DOTALL)

#: Part of a study's page -> the picture that is taken of it.
PICTURES = {
    "paths-of-the-box": "paths",
    "tracking-of-the-forward-speed": "speed",
    "density-of-the-running-cost": "costs",
    "parameters-over-time": "parameters",
    "t5-final-configuration": "final",
    "ablations": "ablations",
}
#: Shows the figures of a part at the top of the window, and tells their height [px]; 0: it has none.
SHOW = """(() => {{ const all = [...document.querySelectorAll('#{0}')];
const it = all.map((one) => one.querySelector('figure.plots')).find((one) => one);
document.querySelector('nav')?.remove(); it?.scrollIntoView(); return it?.offsetHeight ?? 0; }})()"""


def main() -> None:
    """Make every study's files again, and fill the page."""
    folders = sorted(path.parent for path in STUDIES.glob("*/study.json"))
    if not folders:
        sys.exit(
            f"{STUDIES}: holds no study; make one: amhe eval -o docs/results/main (docs/results.md has all)"
        )
    for folder in folders:
        if (folder / PACKED).is_file():
            ZipFile(folder / PACKED).extractall(folder / CELLS)
        found = write_study(open_store(folder), {name: task.floor for name, task in TASKS.items()}, MODES)
        take_pictures(folder)
        pack(folder)
        print(f"{folder.name}: {found.cells} cells")
    PAGE.write_text(filled(PAGE.read_text(encoding="utf-8"), PAGE.parent), encoding="utf-8")


def pack(folder: Path) -> None:
    """Move the result files of a study into one file, equal ones into equal bytes."""
    with ZipFile(folder / PACKED, "w") as archive:
        for file in sorted((folder / CELLS).glob("*.json")):
            archive.writestr(ZipInfo(file.name, (1980, 1, 1, 0, 0, 0)), file.read_bytes(), ZIP_LZMA)
    shutil.rmtree(folder / CELLS)


def take_pictures(folder: Path) -> None:
    """The figures of a study's page as pictures, in its folder `figures`."""
    (folder / "figures").mkdir(exist_ok=True)
    with TemporaryDirectory(ignore_cleanup_errors=True) as scratch, browser(Path(scratch)) as one:
        for part, name in PICTURES.items():
            one.open((folder / "report.html").resolve().as_uri(), 1180, 800)
            if height := int(one.run(SHOW.format(part))):
                one.open((folder / "report.html").resolve().as_uri(), 1180, height)
                one.run(SHOW.format(part))
                one.picture(folder / "figures" / f"{name}.png")


def filled(text: str, beside: Path) -> str:
    """A page with its blocks filled; those of studies that are not stored stay as they are.

    Args:
        text: Of the page.
        beside: Folder of the page, for links.
    """

    def fill(block: re.Match[str]) -> str:
        folder = STUDIES / block["study"]
        if not folder.is_dir():
            return block[0]
        content = _content(open_store(folder), block["what"], beside)
        return f"<!-- results {block['study']}/{block['what']} -->\n{content.rstrip()}\n<!-- end -->"

    return BLOCK.sub(fill, text)


def _content(store: Store, what: str, beside: Path) -> str:
    if what == "made":
        return _made(store)
    if what == "figures":
        pictures = sorted((store.folder / "figures").glob("*.png"))
        return "\n\n".join(
            f"![{path.stem}]({Path(os.path.relpath(path, beside)).as_posix()})" for path in pictures
        )
    table = store.folder / "tables" / f"{'goals' if what == 'missed' else what}.md"
    if not table.is_file():
        sys.exit(
            f"{store.folder}: makes no table {what!r}; correct the block, or run the cells that it needs"
        )
    text = table.read_text(encoding="utf-8")
    return _missed(text) if what == "missed" else text


def _missed(goals: str) -> str:
    """How many goals are reached, and the table's rows of those that are not."""
    _, _, head, rule, *rows = goals.splitlines()
    missed = [row for row in rows if row.endswith("| NO |")]
    reached = f"{len(rows) - len(missed)} of {len(rows)} goals are reached"
    return "\n".join((f"{reached}; missed are", "", head, rule, *missed)) if missed else f"{reached}."


def _made(store: Store) -> str:
    study = store.study
    commands = "\n".join(study.commands)
    versions = ", ".join(f"{name} {version}" for name, version in study.code.items())
    machine = ", ".join(f"{name} {value}" for name, value in study.machine.items())
    return f"```sh\n{commands}\n```\n\nBegun {study.made[:10]}; {versions}; {machine}."


if __name__ == "__main__":
    main()
