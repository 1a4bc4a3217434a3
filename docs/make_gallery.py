"""Make docs/gallery/, pages of results to look at without an install: `python docs/make_gallery.py FOLDER`.

FOLDER keeps the results between runs; those that are missing are made, in some four minutes.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

GALLERY = Path(__file__).with_name("gallery")
#: Name -> the commands that make its result, in the folder NAME.
RESULTS = {
    "pendulum": [("identify", "example:pendulum", "-o", "pendulum")],
    "arm": [
        ("init", "example:arm", "example:arm", "--actuators", "-o", "arm-system", "--force"),
        ("identify", "example:arm", "--system", "arm-system", "-o", "arm"),
    ],
    "go1": [("identify", "example:t1", "-o", "go1")],
}


def main() -> None:
    """Make the results that are missing, and copy their pages."""
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    GALLERY.mkdir(exist_ok=True)
    for name, commands in RESULTS.items():
        if not (folder / name / "view.html").exists():
            for command in commands:
                subprocess.run([sys.executable, "-m", "amhe_cli", *command], cwd=folder, check=True)
        for page in ("report", "view"):
            text = (folder / name / f"{page}.html").read_text(encoding="utf-8")
            for other in ("report", "view"):
                text = text.replace(f'"{other}.html', f'"{name}-{other}.html')
            (GALLERY / f"{name}-{page}.html").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
