"""What docs/systems.md shows is a system that loads."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

from amhe_cli.core.bundled import bundled_root
from amhe_cli.system.description.schema import KINDS, ParameterEntry, SignalEntry
from amhe_cli.system.description.targets import WORDS
from amhe_cli.system.system import System

PAGE = Path(__file__).parents[2] / "docs" / "systems.md"


def test_the_example_loads(tmp_path: Path) -> None:
    example = next(re.finditer(r"```yaml\n(.*?)```", PAGE.read_text(), re.DOTALL)).group(1)
    scene = (bundled_root() / "models" / "pendulum" / "scene.xml").read_text()
    (tmp_path / "scene.xml").write_text(
        scene.replace("</mujoco>", '<keyframe><key name="home"/></keyframe></mujoco>')
    )
    (tmp_path / "system.yaml").write_text(example)
    system = System.load(tmp_path)
    assert system.space.names == ("load_mass",)
    assert system.keyframe == 0


#: A model with what the shorter examples name.
SCENE = """
<mujoco>
  <worldbody>
    <body name="box" pos="1 0 0"><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body>
    <body><joint name="shoulder" axis="0 1 0"/><geom size="0.1"/>
      <body pos="0 0 -0.3"><joint name="elbow" axis="0 1 0"/><geom size="0.05"/><site name="wrist"/></body>
    </body>
    <body pos="0 1 0"><joint name="hinge" axis="0 1 0"/><geom size="0.1"/></body>
  </worldbody>
  <actuator><position name="servo" joint="hinge" kp="1"/></actuator>
</mujoco>
"""
SIGNALS = "signals: {joints: {topic: /q, joints: [elbow], noise: {position: 0.002}}}\n"
PARAMETERS = "parameters:\n  mass: {targets: [{body: box, set: mass}]}\n"


def test_the_examples_of_signals_load(tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text(SCENE)
    examples = [
        text
        for text in re.findall(r"```yaml\n(.*?)```", PAGE.read_text(), re.DOTALL)
        if text.startswith(("signals:", "parameters:"))
    ]
    examples += re.findall(r"```yaml\n(signals:.*?)```", PAGE.with_name("servo.md").read_text(), re.DOTALL)
    assert len(examples) == 5
    for text in examples:
        parameters = "" if text.startswith("parameters:") else PARAMETERS
        signals = "" if "signals:" in text else SIGNALS
        (tmp_path / "system.yaml").write_text(f"model: scene.xml\n{parameters}{text}{signals}")
        System.load(tmp_path, warn=False)


def test_every_target_kind_and_key_is_explained() -> None:
    text = PAGE.read_text()
    for word in (*WORDS, *KINDS, *ParameterEntry.model_fields, *SignalEntry.model_fields):
        assert f"`{word}" in text or f"{word}:" in text, word


def test_bundled_folders_can_be_copied_and_used_from_anywhere(tmp_path: Path) -> None:
    for name in ("pendulum", "cube_toss"):
        shutil.copytree(bundled_root() / "models" / name, tmp_path / name)
        assert System.load(tmp_path / name).name == name
