"""Make docs/figures/TASK.jpg: `MUJOCO_GL=egl python docs/make_task_figures.py t5 0.02 0.25 0.42 1`.

The task is run once with the true belief (seed 0); the numbers are the shares of its time that are shown.
"""

from __future__ import annotations

import sys
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image

from amhe_cli.robots.go1.run import RunOptions, open_run

#: Size of one picture, and the gap between two [pixels].
WIDTH, HEIGHT, GAP = 400, 320, 6
#: Colours of the goal and of the path.
GREEN, BLUE = (0.1, 0.6, 0.25, 0.45), (0.2, 0.4, 0.85, 1.0)


def main() -> None:
    """Run a task, and write its pictures side by side."""
    name, shares = sys.argv[1], [float(word) for word in sys.argv[2:]]
    run = open_run(RunOptions(name, mode="true", seed=0))
    plant = run.plant
    assert plant is not None
    states = [plant.qpos for _ in run.episode.cycles()]
    whole = Image.new("RGB", (len(shares) * (WIDTH + GAP) - GAP, HEIGHT), "white")
    data = mujoco.MjData(plant.model)
    with mujoco.Renderer(plant.model, HEIGHT, WIDTH) as renderer:
        for i, share in enumerate(shares):
            data.qpos[:] = states[round(share * (len(states) - 1))]
            mujoco.mj_forward(plant.model, data)
            renderer.update_scene(data, _camera(data, run.task.path.heading))
            _add_course(renderer.scene, run.task)
            whole.paste(Image.fromarray(renderer.render()), (i * (WIDTH + GAP), 0))
    path = Path(__file__).parent / "figures" / f"{name}.jpg"
    whole.save(path, quality=88)
    print(f"{path.name}: {len(states) * 0.02:.1f} s, {path.stat().st_size / 1e3:.0f} kB")


def _camera(data: mujoco.MjData, heading: float) -> mujoco.MjvCamera:
    """Follows robot and box, from their side."""
    camera = mujoco.MjvCamera()
    camera.lookat[:] = 0.5 * (data.body("trunk").xpos + data.body("box").xpos)
    camera.lookat[2] = 0.15
    camera.distance, camera.elevation = 1.6, -25.0
    camera.azimuth = float(np.degrees(heading)) + 270.0 if abs(heading) > 1.0 else 120.0
    return camera


def _add_course(scene: mujoco.MjvScene, task) -> None:
    """The path, and where the box is to go."""
    points = task.path.points(np.linspace(0.0, task.path.length, 41))
    size = 0.5 * np.array(task.box.size)
    goal = ([*task.path.goal, 0.004], [size[0], size[1], 0.002], GREEN)
    line = [([*point, 0.003], [0.012, 0.012, 0.002], BLUE) for point in points]
    for at, extent, colour in (goal, *line):
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(
            geom, mujoco.mjtGeom.mjGEOM_BOX, np.array(extent), np.array(at), np.eye(3).ravel(),
            np.array(colour, dtype=np.float32),
        )  # fmt: skip
        scene.ngeom += 1


if __name__ == "__main__":
    main()
