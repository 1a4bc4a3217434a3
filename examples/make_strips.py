"""Make the picture strips of the documentation: a task at a few instants, side by side.

    MUJOCO_GL=egl python examples/make_strips.py t1 t5 --out docs/figures

MUJOCO_GL=osmesa where there is no EGL; a task takes about its own time.
"""

import argparse
from pathlib import Path

import mujoco
import numpy as np
from matplotlib.image import imsave

from amhe_cli.robots.go1.model import layout
from amhe_cli.robots.go1.run import Run, RunOptions, open_run

#: Of one picture [pixels]; more is drawn, and the middle kept.
SIZE, WIDTH, GAP = (640, 320), 400, 6


def pictures(run: Run, count: int) -> list[np.ndarray]:
    """The plant at `count` instants of a run, seen from beside robot and box."""
    seen = [run.plant.qpos.copy() for _ in run.episode.cycles()]
    model, data, at = run.plant.model, mujoco.MjData(run.plant.model), layout(run.plant.model)
    model.mat_reflectance[:] = 0.0
    camera = mujoco.MjvCamera()
    leg = run.task.floor.one_leg
    camera.distance, camera.azimuth, camera.elevation = (2.2, 188, -24) if leg else (3.0, 108, -20)
    found = []
    with mujoco.Renderer(model, SIZE[1], SIZE[0]) as renderer:
        for row in np.linspace(0, len(seen) - 1, count).astype(int):
            data.qpos[:] = seen[row]
            mujoco.mj_forward(model, data)
            camera.lookat[:2] = 0.5 * (data.qpos[at.trunk][:2] + data.qpos[at.box][:2])
            camera.lookat[2] = 0.16
            renderer.update_scene(data, camera)
            left = (SIZE[0] - WIDTH) // 2
            found.append(renderer.render()[:, left : left + WIDTH].copy())
    return found


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
    white = np.full((SIZE[1], GAP, 3), 255, np.uint8)
    for task in given.tasks:
        run = open_run(RunOptions(task, given.mode, seed=given.seed, threads=2, duration=given.until or 40.0))
        parts = [part for picture in pictures(run, given.count) for part in (white, picture)]
        path = given.out / f"{task}.jpg"
        imsave(path, np.concatenate(parts[1:], axis=1), pil_kwargs={"quality": 88})
        print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
