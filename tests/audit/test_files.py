"""Two files of one robot: what differs, and by how much it matters."""

from pathlib import Path

import numpy as np
import pytest

from amhe_cli.audit.files import compare
from amhe_cli.system.model.files import compiled, read_spec
from amhe_cli.system.numbers import numbers_of

ROOT = Path(__file__).parents[2]
ARM = ROOT / "examples" / "logs" / "arm.xml"

URDF = """<robot name="arm"><link name="base_link"/>
<link name="rod_link"><inertial><origin xyz="0.1 0 0"/><mass value="{mass}"/>
<inertia ixx="0.001" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="hinge" type="continuous"><parent link="base_link"/><child link="rod_link"/><axis xyz="0 1 0"/>
<dynamics damping="0.3" friction="0"/></joint></robot>"""
MJCF = """<mujoco><worldbody><body name="rod"><joint name="hinge_joint" axis="0 1 0" damping="0.3"/>
<inertial pos="0.1 0 0" mass="2" diaginertia="0.001 0.02 0.02"/></body></worldbody></mujoco>"""


def changed(tmp_path: Path, *pairs: tuple[str, str]) -> Path:
    text = ARM.read_text()
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "changed.xml"
    path.write_text(text)
    return path


def test_a_file_does_not_differ_from_itself() -> None:
    model = compiled(read_spec(ARM))
    found = compare(model, model)
    assert not found.differences and not any(found.alone)
    assert found.alike == len(numbers_of(model, axes=False)) + 3 + 3  # places of two bodies on others, ranges


def test_what_differs_is_listed_by_what_it_is_worth(tmp_path: Path) -> None:
    other = changed(tmp_path, ('mass="1.2"', 'mass="3.6"'), ('damping="0.4"', 'damping="0.41"'))
    found = compare(*(compiled(read_spec(path)) for path in (ARM, other)))
    first = found.differences[0]
    assert (first.of, first.what) == ("upper_arm", "mass")
    assert np.isclose(first.other[0] / first.one[0], 3.0)
    weights = [d.weight for d in found.differences]
    assert weights == sorted(weights, reverse=True)
    assert {d.what for d in found.differences} == {"mass", "inertia", "damping"}
    assert found.masses == pytest.approx((3.0, 5.4))


def test_a_weight_is_the_share_of_the_forces(tmp_path: Path) -> None:
    """A joint that only damping loads needs twice the force where damping is twice as large."""
    paths = []
    for damping in (1, 2):
        path = tmp_path / f"{damping}.xml"
        path.write_text(
            '<mujoco><option gravity="0 0 0"/><worldbody><body name="rod">'
            f'<joint name="j" damping="{damping}"/>'
            '<inertial pos="0 0 0" mass="1e-9" diaginertia="1e-12 1e-12 1e-12"/></body></worldbody></mujoco>'
        )
        paths.append(path)
    found = compare(*(compiled(read_spec(path)) for path in paths))
    assert [d.what for d in found.differences] == ["damping"]
    assert found.differences[0].weight == pytest.approx(1.0, abs=1e-3)


def test_urdf_and_mjcf_are_matched_by_names(tmp_path: Path) -> None:
    urdf, mjcf = tmp_path / "a.urdf", tmp_path / "b.xml"
    urdf.write_text(URDF.format(mass=4))
    mjcf.write_text(MJCF)
    found = compare(*(compiled(read_spec(path)) for path in (urdf, mjcf)))
    (only,) = found.differences
    assert (only.of, only.what, only.one, only.other) == ("rod_link", "mass", (4.0,), (2.0,))
    assert found.alone == ((), ())
