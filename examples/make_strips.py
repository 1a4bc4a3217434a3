"""Make the picture strips of the documentation: a task at a few instants, side by side.

    python examples/make_strips.py t1 t5 --out docs/figures

Needs EGL or OSMesa; a task takes about its own time.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.image import imsave

from amhe_cli.robots.go1.run import RunOptions, open_run
from amhe_cli.robots.go1.video import Film, strip

#: Of one picture [pixels]; more is drawn, and the middle kept.
SIZE, WIDTH = (640, 320), 400


def main() -> None:
    parser = argparse.ArgumentParser(description="Picture strips of tasks.")
    parser.add_argument("tasks", nargs="+", help="t1 ... t5, hw1, hw2")
    parser.add_argument("--mode", default="true")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=4, help="pictures of a strip")
    parser.add_argument("--until", type=float, help="time of the last picture [s]; default: the end")
    parser.add_argument("--out", type=Path, default=Path())
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    for task in given.tasks:
        run = open_run(RunOptions(task, given.mode, seed=given.seed, threads=2, duration=given.until or 40.0))
        seen = [run.target.qpos for _ in run.episode.cycles()]
        rows = np.linspace(0, len(seen) - 1, given.count).astype(int)
        film = Film(run.plant.model, run.task.floor, SIZE)
        picture = strip([film.frame(seen[row]) for row in rows], WIDTH)
        film.close()
        path = given.out / f"{task}.jpg"
        imsave(path, np.ascontiguousarray(picture), pil_kwargs={"quality": 88})
        print(f"{path}: {picture.shape[1]} x {picture.shape[0]}, {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
