"""Make the documentation's figure of a replay: the estimates over time, out of its report.

amhe mhe-replay -o replay/
python examples/make_replay_figure.py replay/ docs/figures/replay.svg
"""

import argparse
import re
from pathlib import Path


def main() -> None:
    parser = argparse.ArgumentParser(description="Figure of a replay.")
    parser.add_argument("replay", type=Path, help="folder that amhe mhe-replay wrote")
    parser.add_argument("figure", type=Path, help="SVG file to write")
    given = parser.parse_args()
    page = (given.replay / "report.html").read_text(encoding="utf-8")
    head, body = re.findall(r"(<svg[^>]*>)(.*?</svg>)", page, re.DOTALL)[0]
    # a page has its own paper, a picture in a README may lie on a dark one
    paper = '<rect width="100%" height="100%" fill="#ffffff"/>'
    given.figure.write_text(f"{head}{paper}{body}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
