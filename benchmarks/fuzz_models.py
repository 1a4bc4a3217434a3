"""Mutated models, meshes, images, YAML files and results: each is read, or refused in one line.

    PYTHONPATH=. python benchmarks/fuzz_models.py [--cases N] [--seed S] [KIND ...]

A case is a file with flipped bits, a cut, a piece moved or repeated, a number that lies, or a word put where
it does not belong. It is read as its command reads it, in a process of its own with 4 GiB of address space
and 60 s.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import logging
import re
import shutil
import struct
import tempfile
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

import amhe_cli as amhe
from amhe_cli.cli.main import run
from amhe_cli.init.folder import init_system
from amhe_cli.logs import members
from benchmarks.fuzz_logs import HEAD, mutated, row
from tests.logs.test_every_format import SMALL

PENDULUM = amhe.System.load("pendulum")
MODELS = Path(__file__).resolve().parents[1] / "models"
#: What somebody, or something, may put where a number or a word is.
WORDS = (
    b"1e400", b"-1", b"nan", b".inf", b"!!bool x", b"!!timestamp x", b"!!python/name:os.system", b"[]", b"{}",
    b"{a: {a: 1}}", b"&a [*a]", b"null", b"\x00", b"\x1b[31m", b"9" * 400, b"a" * 70_000, b"'",
    b'"', b"<", b"1 2",
    b"1000000000", b"../../../etc/passwd", b"/dev/zero", b"\xff\xfe", b"${9**9}", b"*", b"0x7f",
)  # fmt: skip
SCENE = """<mujoco><compiler meshdir="."/>
  <asset><mesh name="part" file="part.stl"/><mesh name="other" file="other.obj"/>
    <texture name="skin" type="2d" file="skin.png"/><material name="m" texture="skin"/>
    <hfield name="ground" file="skin.png" size="1 1 .1 .1"/></asset>
  <include file="more.xml"/>
  <worldbody><geom type="hfield" hfield="ground" pos="0 0 -3"/>
    <body name="link"><joint name="hinge" axis="0 1 0" damping=".01" frictionloss=".01" armature=".001"/>
      <geom type="mesh" mesh="part" material="m"/><body pos="0 0 -.5"><joint name="slide" type="slide"/>
        <geom name="load" type="mesh" mesh="other" mass=".2"/><site name="tip"/></body></body></worldbody>
  <tendon><fixed name="t"><joint joint="hinge" coef="1"/></fixed></tendon>
  <equality><joint joint1="slide" polycoef="0 0 0 0 0"/></equality>
  <actuator><position name="servo" joint="hinge" kp="20"/></actuator>
  <sensor><framepos objtype="site" objname="tip"/></sensor>
  <keyframe><key qpos="0 0"/></keyframe></mujoco>"""
MORE = '<mujoco><option timestep=".002"/><default><geom rgba=".5 .5 .5 1"/></default></mujoco>'
SYSTEM = """model: scene.xml
signals:
  joints: {topic: /joints, joints: [hinge, slide], noise: {position: 0.002}}
  command: {topic: /command, actuators: {servo: hinge}, quantity: position}
parameters:
  load: {targets: [{body: link, set: mass}], nominal: 0.3, prior_sd: 0.5, bounds: [0.01, 5]}
settings: {clips: {count: 4}}
"""
ROBOT = """<robot name="r"><material name="m"><color rgba="1 0 0 1"/></material>
  <link name="base"/>
  <link name="arm"><visual><geometry><mesh filename="part.stl" scale="1 1 1"/></geometry></visual>
    <inertial><mass value="1"/>
    <inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="hinge" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="5" velocity="3"/><dynamics damping=".01"/></joint></robot>"""
RUNS = """logs:
  - {log: log.csv, known: {load_mass: 0.5}, from: 0.1, to: 1.0, topics: {joints: /a}}
  - {log: log.csv, own: {damping: robot A}, held_out: true}
"""


def _files(folder: Path) -> None:
    """A mesh of each kind, an image, and a log."""
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], dtype=np.float32)
    faces = [(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)]
    triangles = b"".join(bytes(12) + corners[list(face)].tobytes() + bytes(2) for face in faces)
    (folder / "part.stl").write_bytes(bytes(80) + struct.pack("<I", len(faces)) + triangles)
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    (folder / "other.obj").write_text("\n".join(lines) + "\n")

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    pixels = zlib.compress(b"".join(b"\0" + bytes(range(24)) for _ in range(8)))
    head = struct.pack(">IIBBBBB", 8, 8, 8, 2, 0, 0, 0)
    image = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
    (folder / "skin.png").write_bytes(image)
    times = np.arange(100) / 50.0
    rows = "".join(f"{t:.2f},{np.sin(t):.5f},{np.sin(t):.5f}\n" for t in times)
    (folder / "log.csv").write_text("time,hinge_pos,hinge_cmd\n" + rows)


def _system(folder: Path) -> None:
    _files(folder)
    for name, text in {"scene.xml": SCENE, "more.xml": MORE, "system.yaml": SYSTEM}.items():
        (folder / name).write_text(text)


def _bundled(folder: Path) -> None:
    shutil.copytree(MODELS / "go1_push", folder, dirs_exist_ok=True)


def _urdf(folder: Path) -> None:
    _files(folder)
    (folder / "robot.urdf").write_text(ROBOT)


def _belief(folder: Path) -> None:
    amhe.Belief.save(_result().belief, folder / "belief.yaml")


def _runs(folder: Path) -> None:
    _files(folder)
    (folder / "runs.yaml").write_text(RUNS)


def _result() -> amhe.Result:
    system = amhe.System.load("pendulum", SMALL)
    return amhe.identify(system, [amhe.read_log("example:pendulum", system, end=2.0)], threads=1)


def _view(folder: Path) -> None:
    """`amhe view` of a result; an error that it does not expect is raised again."""
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        code = run(["view", str(folder), "--out", str(folder / "page.html"), "-q"])
    if "Traceback" in said.getvalue():
        raise RuntimeError(said.getvalue())
    if code:
        raise amhe.AmheError("refused")


def _save(folder: Path) -> None:
    _result().save(folder / "result")
    record = json.loads((folder / "result" / "result.json").read_text())
    assert record["schema_version"]


#: What is mutated -> makes its files, and reads them as a command does.
KINDS: dict[str, tuple[Callable[[Path], object], Callable[[Path], object]]] = {
    "system folder": (_system, lambda folder: amhe.System.load(folder)),
    "bundled MJCF": (_bundled, lambda folder: amhe.System.load(folder)),
    "URDF": (_urdf, lambda folder: init_system(folder / "robot.urdf", [folder / "log.csv"], folder / "out")),
    "MJCF by init": (
        _system,
        lambda folder: init_system(folder / "scene.xml", [folder / "log.csv"], folder / "out"),
    ),
    "belief.yaml": (_belief, lambda folder: amhe.Belief.load(folder / "belief.yaml", PENDULUM)),
    "data set": (_runs, lambda folder: members(folder / "runs.yaml", PENDULUM)),
    "result folder": (_save, lambda folder: _view(folder / "result")),
}
#: Files that are not mutated: reports are written, and never read.
SPARED = (".html", ".csv")


def changed(content: bytes, rng: np.random.Generator, text: bool) -> bytes:
    """The content with faults of a file; of a text, or with a word in place of another."""
    if not text or rng.random() < 0.4:
        return mutated(content, rng)
    for _ in range(int(rng.integers(1, 4))):
        places = list(re.finditer(rb"[\w.+-]+", content))
        at = places[int(rng.integers(len(places)))].span() if places else (0, 0)
        content = content[: at[0]] + WORDS[int(rng.integers(len(WORDS)))] + content[at[1] :]
    return content


def fuzz(name: str, cases: int, seed: Sequence[int]) -> None:
    """Print the row of one kind."""
    make, read = KINDS[name]
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as scratch:
        whole, folder = Path(scratch) / "whole", Path(scratch) / "case"
        whole.mkdir()
        make(whole)
        files = sorted(f for f in whole.rglob("*") if f.is_file() and f.suffix not in SPARED)

        def case() -> Callable[[], object]:
            chosen = files[int(rng.integers(len(files)))]
            text = chosen.suffix not in (".stl", ".png")
            shutil.rmtree(folder, ignore_errors=True)
            shutil.copytree(whole, folder)
            (folder / chosen.relative_to(whole)).write_bytes(changed(chosen.read_bytes(), rng, text))
            return lambda: read(folder)

        row(name, cases, case)


def main() -> None:
    """Print a row for each kind."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("kinds", nargs="*", default=list(KINDS), metavar="|".join(KINDS))
    parser.add_argument("--cases", type=int, default=7000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    logging.disable(logging.WARNING)
    print(HEAD, flush=True)
    for number, name in enumerate(KINDS):
        if name in options.kinds:
            fuzz(name, options.cases // len(KINDS), (options.seed, number))


if __name__ == "__main__":
    main()
