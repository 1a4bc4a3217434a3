"""xacro: its language works; no file runs code, reads what lies elsewhere, or costs without bound."""

from __future__ import annotations

import time
from pathlib import Path
from xml.etree import ElementTree

import pytest

from amhe_cli.core.errors import ConfigError
from amhe_cli.core.limits import limit
from amhe_cli.system.model.urdf import UrdfOptions, urdf_text
from amhe_cli.system.system import System

pytest.importorskip("xacro")

#: A system whose model is a xacro file.
SYSTEM_YAML = """model: robot.xacro
parameters: {mass: {nominal: 1, targets: [{body: base, set: mass}]}}
signals: {joints: {topic: /joints, joints: [hinge], noise: {position: 0.01}}}
"""
#: Gets at `os.system` by way of classes; what follows is the command.
SYSTEM = (
    "[c for c in x.__class__.__base__.__subclasses__() if c.__name__=='_wrap_close'][0]"
    ".__init__.__globals__['system']"
)


def expanded(path: Path, inner: str, **options: object) -> ElementTree.Element:
    """A robot of these elements, expanded."""
    head = '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">'
    path.write_text(f"{head}{inner}</robot>")
    return ElementTree.fromstring(urdf_text(path, UrdfOptions(**options))[0])  # type: ignore[arg-type]


def value_of(path: Path, expression: str, before: str = "", **options: object) -> str:
    """What an expression becomes as the name of a link."""
    link = expanded(path, f'{before}<link name="{expression}"/>', **options).find("link")
    assert link is not None
    return link.get("name", "")


@pytest.mark.parametrize(
    ("expression", "value"),
    [
        ("${1 + 2*3}", "7"),
        ("${-2**2 % 3}", "2"),
        ("${7 // 2 + int(2.5)}", "5"),
        ("${round(math.sin(pi/2), 3)}", "1.0"),
        ("${radians(180) == pi}", "True"),
        ("${1 &lt; 2 &lt; 3 and not 2 in [3, 4]}", "True"),
        ("${0 or 'b'}_${'x' if 1 > 2 else 'y'}", "b_y"),
        ("${len('abc') + max(1, 2)}", "5"),
        ("${'left_leg'.split('_')[0].upper()}", "LEFT"),
        ("${[1, 2, 3][1:][0]}", "2"),
        ("${dict(a=1, b=2)['b']}", "2"),
        ("${xacro.dotify(dict(a=dict(b=4))).a.b}", "4"),
        ("${list(map(float, xacro.tokenize('1 2')))}", "[1.0, 2.0]"),
        ("${python.sorted([2, 1])}", "[1, 2]"),
        ("${'%.2f' % 1.234}", "1.23"),
        ("$(arg size)", "3"),
        ("${xacro.arg('size')}", "3"),
        ("${xacro.load_yaml('sizes.yaml').legs[1].mass + load_yaml('sizes.yaml')['extra']}", "2.5"),
        ("$(optenv HOME none)", "none"),
        ("$${1}", "${1}"),
    ],
)
def test_the_language_of_xacro(tmp_path: Path, expression: str, value: str) -> None:
    (tmp_path / "sizes.yaml").write_text("legs: [{mass: 1}, {mass: 2}]\nextra: !degrees 0\nextra: 0.5\n")
    assert value_of(tmp_path / "a.xacro", expression, xacro_args={"size": "3"}) == value


def test_properties_conditions_and_macros(tmp_path: Path) -> None:
    robot = expanded(
        tmp_path / "a.xacro",
        """<xacro:property name="n" value="2"/><xacro:property name="twice" value="${2*n}"/>
        <xacro:macro name="leg" params="side length:=${twice} *more"><link name="${side}_${length}"/>
          <xacro:if value="${side == 'left'}"><link name="only_left"/></xacro:if>
          <xacro:insert_block name="more"/></xacro:macro>
        <xacro:leg side="left"><a/></xacro:leg><xacro:leg side="right" length="7"><b/></xacro:leg>""",
    )
    assert [link.get("name") for link in robot.iter("link")] == ["left_4", "only_left", "right_7"]
    assert robot.find("a") is not None


@pytest.mark.parametrize(
    "expression",
    [
        "${[SYSTEM('touch TOUCHED') for x in [()]]}",
        "${(lambda x: SYSTEM('touch TOUCHED'))(())}",
        "${map(python.type, ['A'], [()], [dict()])}",
        "${python.vars(len)}",
        "${type(1)}",
        "${map(str.format, ['{0.__globals__}'], [xacro.load_yaml])}",
        "${'{0.__class__}'.format(1)}",
        "${python.root}",
        "${python.parent.update(len=1)}",
        "${xacro.load_yaml.__globals__}",
        "${__builtins__}",
        "${(1).real}",
        "${[*'ab']}",
        "${len(*['ab'])}",
        "${(y := 1)}",
        "${f'{1}'",
        "${dict(**dict())}",
        "${b''.hex()}",
    ],
)
def test_an_expression_is_none_of_python_beyond_arithmetic(tmp_path: Path, expression: str) -> None:
    path = tmp_path / "a.xacro"
    text = expression.replace("SYSTEM", SYSTEM).replace("TOUCHED", str(tmp_path / "touched"))
    with pytest.raises(ConfigError, match=r"a\.xacro: xacro: .*\S") as caught:
        value_of(path, text)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "touched").exists()


def test_eval_of_substitutions_runs_nothing(tmp_path: Path) -> None:
    inner = f"""<xacro:property name="p" value="open('{tmp_path}/touched', 'w')"/>"""
    with pytest.raises(ConfigError, match=r"\$\(eval .* would run Python: write \$\{"):
        value_of(tmp_path / "a.xacro", "$(eval ${p})", inner)
    assert not (tmp_path / "touched").exists()


def test_no_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AMHE_SECRET", "hush")
    with pytest.raises(ConfigError, match="variable 'AMHE_SECRET' is not set"):
        value_of(tmp_path / "a.xacro", "$(env AMHE_SECRET)")


@pytest.mark.parametrize(
    "inner",
    [
        """<link name="${xacro.load_yaml('../secret.yaml')}"/>""",
        """<link name="${xacro.load_yaml('$(find elsewhere)/secret.yaml')}"/>""",
        """<xacro:include filename="../secret.yaml"/>""",
        """<xacro:include filename="link.yaml"/>""",
        """<xacro:include filename="../*.yaml"/>""",
    ],
)
def test_no_file_of_another_folder(tmp_path: Path, inner: str) -> None:
    folder = tmp_path / "elsewhere" / "robot"
    folder.mkdir(parents=True)
    (tmp_path / "elsewhere" / "secret.yaml").write_text("hush")
    (folder / "link.yaml").symlink_to("../secret.yaml")
    with pytest.raises(ConfigError, match=r"secret\.yaml is neither in the folder of this file") as caught:
        expanded(folder / "a.xacro", inner)
    assert "hush" not in str(caught.value)


@pytest.mark.medium
@pytest.mark.parametrize(
    "inner",
    [
        "<link name='${9**9**9}'/>",
        "<link name='${len(list(range(10**12)))}'/>",
        "<link name='${9**10**6*[1]}'/>",
        "<xacro:macro name='a' params='n'><xacro:if value='${n > 0}'><xacro:a n='${n-1}'/>"
        "<xacro:a n='${n-1}'/></xacro:if></xacro:macro><xacro:a n='26'/>",
        "<xacro:macro name='a'><xacro:a/></xacro:macro><xacro:a/>",
        "".join(f"<xacro:property name='p{i}' value='${{p{i + 1}}}${{p{i + 1}}}'/>" for i in range(60))
        + "<xacro:property name='p60' value='text'/><link name='${p0}'/>",
        "<xacro:macro name='w'><xacro:if value='${map(xacro.warning, [0]) != 0}'>${xacro.warning(5000*'w')}"
        "</xacro:if></xacro:macro>" + 2000 * "<xacro:w/>",
    ],
)
def test_its_cost_is_bounded(tmp_path: Path, inner: str) -> None:
    began = time.monotonic()
    with limit(xacro_seconds=1, model_mib=1), pytest.raises(ConfigError, match="xacro: ") as caught:
        expanded(tmp_path / "a.xacro", inner)
    assert time.monotonic() - began < 8.0
    assert "\n" not in str(caught.value)


def test_a_system_opens_no_xacro(tmp_path: Path) -> None:
    (tmp_path / "robot.xacro").write_text('<robot name="r"><link name="base"/></robot>')
    (tmp_path / "system.yaml").write_text(SYSTEM_YAML)
    with pytest.raises(ConfigError, match=r"a system names no xacro file; `amhe init` writes"):
        System.load(tmp_path)
