"""How long `amhe --help` takes against importing click alone, the least that any such command costs.

python benchmarks/startup.py [--repetitions 15] [--quick]
"""

from __future__ import annotations

import argparse
import subprocess
import sys

from common import paired, show

RATIO_GOAL, SECONDS_GOAL = 2.0, 0.3


def started(*arguments: str) -> None:
    """Run Python to its end."""
    subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repetitions", type=int, default=15)
    parser.add_argument("--quick", action="store_true", help="5 repetitions")
    arguments = parser.parse_args()
    click, amhe, ratio = paired(
        lambda: started("-c", "import click"),
        lambda: started("-m", "amhe_cli", "--help"),
        5 if arguments.quick else arguments.repetitions,
    )
    met = ratio <= RATIO_GOAL and amhe <= SECONDS_GOAL
    show(
        f"Start of the command (goal {RATIO_GOAL:g}x and {SECONDS_GOAL:g} s)",
        ("import click", "amhe --help", "ratio", "in goal"),
        [(f"{click:.3f} s", f"{amhe:.3f} s", f"{ratio:.2f}x", "yes" if met else "NO")],
    )


if __name__ == "__main__":
    main()
