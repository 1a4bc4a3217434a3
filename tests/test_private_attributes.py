"""Private attributes of other packages that we use: a version that changes one is named here."""

import inspect
import re
import tomllib
from importlib.metadata import version
from itertools import chain
from pathlib import Path

import cmaes
import mujoco
import numpy as np
import pytest

from amhe_cli.core.errors import AmheError
from amhe_cli.estimation.offline.cma import memory_of, restore
from amhe_cli.robots.go1.poses.sources import PoseError, _listening_to
from amhe_cli.system.parameters.model_edits import inputs_of_set_const

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
#: What pyproject.toml asks for, in all extras.
REQUIREMENTS = [*PROJECT["dependencies"], *chain(*PROJECT["optional-dependencies"].values())]


def test_mujoco_lists_the_inputs_of_its_derived_constants() -> None:
    known = {"body_mass", "body_inertia", "body_ipos", "dof_armature", "qpos0"}
    assert known <= inputs_of_set_const(), f"broken by mujoco {version('mujoco')}"
    assert "pair_friction" not in inputs_of_set_const(), f"broken by mujoco {version('mujoco')}"


def test_a_mujoco_without_that_list_is_refused_in_one_line(monkeypatch) -> None:
    monkeypatch.delattr(mujoco.MjModel, "_setconst_inputs")
    with pytest.raises(AmheError, match=r"mujoco 4\S* lists no inputs of mj_setConst; install"):
        inputs_of_set_const()


def test_a_cmaes_optimizer_with_the_memory_of_another_continues_as_that_one() -> None:
    one, other = (cmaes.CMA(mean=np.ones(3), sigma=0.5, seed=3, population_size=6) for _ in range(2))
    for _ in range(4):
        samples = [one.ask() for _ in range(6)]
        one.tell([(x, float((x - [1.0, 2.0, 3.0]) @ (x - [0.0, 1.0, 9.0]))) for x in samples])
    try:
        restore(other, memory_of(one))
    except AttributeError as error:
        pytest.fail(f"broken by cmaes {version('cmaes')}: {error}")
    for optimizer in (one, other):  # as the search does for each generation
        optimizer.reseed_rng(7)
    for _ in range(3):
        samples = [one.ask() for _ in range(6)]
        same = np.array_equal(samples, [other.ask() for _ in range(6)])
        assert same, f"broken by cmaes {version('cmaes')}: its state has more than MEMORY"
        for optimizer in (one, other):
            optimizer.tell([(x, float(x @ x)) for x in samples])


def test_natnet_makes_its_sockets_where_we_replace_them() -> None:
    natnet = pytest.importorskip("natnet")
    create = getattr(natnet.NatNetClient, "_NatNetClient__create_socket", None)
    assert create is not None, f"broken by natnet {version('natnet')}"
    assert list(inspect.signature(create).parameters) == ["addr", "port"], f"natnet {version('natnet')}"


def test_a_natnet_that_makes_its_sockets_elsewhere_is_refused() -> None:
    with pytest.raises(PoseError, match="install natnet 0.3"):
        _listening_to("127.0.0.1", type("NatNetClient", (), {}))


@pytest.mark.parametrize("package", ["cmaes", "mujoco", "natnet"])
def test_a_package_whose_private_attributes_we_use_has_an_upper_bound(package: str) -> None:
    (wanted,) = {text for text in REQUIREMENTS if re.match(rf"{package}\b(?!-)", text) and "[" not in text}
    assert re.search(r"<\d", wanted), f"{wanted}: a later version may lack them"
