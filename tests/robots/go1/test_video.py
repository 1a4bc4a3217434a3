"""Films: frames that show something, files that hold frames; skipped where nothing can be drawn."""

from pathlib import Path

import numpy as np
import pytest

from amhe_cli.core.errors import ConfigError
from amhe_cli.robots.go1 import video
from amhe_cli.robots.go1.model import home, plant_model
from amhe_cli.robots.go1.tasks import TASKS

SIZE = (160, 90)


@pytest.fixture
def film():
    task = TASKS["t4"]
    try:
        film = video.Film(plant_model(task.box), task.floor, SIZE)
    except ConfigError as error:
        pytest.skip(str(error))
    yield film
    film.close()


def test_a_frame_shows_robot_box_and_floor_and_the_camera_follows(film) -> None:
    frame = film.frame(home(film._model))
    assert frame.shape == (90, 160, 3)
    red, blue = (frame[..., i].astype(int) for i in (0, 2))
    assert frame.std() > 10.0
    assert ((red - blue) > 40).sum() > 100  # cardboard
    assert ((blue - red) > 60).sum() > 10  # the path

    first, qpos = frame.astype(int), home(film._model)
    qpos[film._at.trunk][0] += 1.0
    qpos[film._at.box][0] += 1.0
    second = film.frame(qpos).astype(int)  # the floor has moved on, robot and box have not
    middle = np.s_[25:60, 50:110]
    assert np.abs(first[middle] - second[middle]).mean() < np.abs(first - second).mean() + 5.0
    assert np.median(np.abs(first[middle] - second[middle])) < 5.0


@pytest.mark.medium
@pytest.mark.parametrize("later", [False, True])
def test_a_film_has_its_frames_also_when_the_run_breaks_off(tmp_path: Path, later: bool) -> None:
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    task = TASKS["t1"]
    model = plant_model(task.box)
    try:
        film = video.Film(model, task.floor, SIZE)
    except ConfigError as error:
        pytest.skip(str(error))
    path = tmp_path / "video.mp4"
    with pytest.raises(RuntimeError), film.shooting(path, later) as shoot:
        for time in (0.02, 0.04, 0.06, 0.08):
            shoot(time, home(model))
        raise RuntimeError
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(path))
    assert frames == 3  # at 0, 0.04 and 0.08 s
    assert seconds == pytest.approx(3 / video.FPS)


def test_where_nothing_draws_each_failure_is_named(monkeypatch) -> None:
    def fails(kind: str, width: int, height: int) -> None:
        raise AttributeError(f"no {kind} here")

    monkeypatch.setattr(video, "_context_of", fails)
    monkeypatch.setattr(video, "_forget_opengl", lambda: None)
    with pytest.raises(ConfigError, match="no .* here.*; .*no .* here"):
        video._gl_context(*SIZE)


def test_a_strip_sets_frames_side_by_side() -> None:
    frames = [np.full((4, 10, 3), value, np.uint8) for value in (1, 2)]
    strip = video.strip(frames, width=6, gap=2)
    assert strip.shape == (4, 14, 3)
    assert strip[0, :, 0].tolist() == [1] * 6 + [255] * 2 + [2] * 6
