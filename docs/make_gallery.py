"""Make docs/gallery/ and pictures of tutorial and audit: `python docs/make_gallery.py FOLDER`, with Chromium.

docs/gallery/ has pages of results to look at without an install. FOLDER keeps the results between runs; those
that are missing are made, in some minutes.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS.parent))
from tests.view.browser import browser  # noqa: E402

#: Name -> the commands that make its result, in the folder NAME.
RESULTS = {
    "pendulum": [("identify", "example:pendulum", "-o", "pendulum")],
    "lie": [("identify", "example:pendulum", "--only", "load_mass,*damping", "-o", "lie")],
    "arm": [
        ("init", "example:arm", "example:arm", "--actuators", "-o", "arm-system", "--force"),
        ("identify", "example:arm", "--system", "arm-system", "-o", "arm"),
    ],
    "audit": [("audit", "example:arm_torque", "example:arm_torque", "-o", "audit")],
    "go1": [
        ("identify", "example:t1", "-o", "go1"),
        # without a link to a report, which is not kept, and of a part: a page stays below 1 MiB
        ("view", "go1", "--to", "8", "-o", "go1/view.html", "--force"),
    ],
}
#: Results whose pages are kept: small ones, and the view of a larger one.
KEPT = {"pendulum": ("report", "view"), "arm": ("report", "view"), "go1": ("view",)}
#: Picture -> page, the part of it that is shown, height.
PICTURES = {
    "tutorial/arm-found.webp": ("arm/report.html", "parameters", 770),
    "tutorial/arm-overlay.webp": ("arm/report.html", "measured-against-predicted", 760),
    "tutorial/arm-budget.webp": ("arm/report.html", "where-each-interval-comes-from", 560),
    "tutorial/arm-view.webp": ("arm/view.html", "top", 1000),
    "tutorial/lie.webp": ("lie/report.html", "top", 560),
    "tutorial/truth.webp": ("pendulum/report.html", "top", 560),
    "audit.webp": ("audit/report.html", "top", 900),
}
#: Shows a part of a page, unfolded, and nothing of the one above it.
SHOW = """(() => {{
  const it = document.getElementById('{0}'), above = it.previousElementSibling;
  it.open = true; it.scrollIntoView();
  if (above.tagName !== 'NAV') above.style.visibility = 'hidden';
}})()"""


def main() -> None:
    """Make the results that are missing, copy their pages, and take the pictures."""
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for name, commands in RESULTS.items():
        if not (folder / name / "report.html").exists():
            for command in commands:
                subprocess.run([sys.executable, "-m", "amhe_cli", *command], cwd=folder, check=True)
    (DOCS / "gallery").mkdir(exist_ok=True)
    for name, pages in KEPT.items():
        for page in pages:
            text = (folder / name / f"{page}.html").read_text(encoding="utf-8")
            for other in pages:
                text = text.replace(f'"{other}.html', f'"{name}-{other}.html')
            text = text.replace(f"{DOCS.resolve().parent}/", "")  # no path of the computer that made them
            (DOCS / "gallery" / f"{name}-{page}.html").write_text(text, encoding="utf-8")
    with TemporaryDirectory(ignore_cleanup_errors=True) as scratch, browser(Path(scratch)) as one:
        for picture, (page, part, height) in PICTURES.items():
            one.open((folder / page).resolve().as_uri(), 1180, height)
            if part != "top":
                one.run(SHOW.format(part))
            one.run("new Promise((done) => setTimeout(done, 1500))")
            one.picture(DOCS / "figures" / picture)


if __name__ == "__main__":
    main()
