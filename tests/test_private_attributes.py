"""Private attributes of other packages that we use: a version that changes one is named here."""

import inspect
from importlib.metadata import version

import cmaes
import mujoco
import numpy as np
import pytest

from amhe_cli.core.errors import AmheError
from amhe_cli.robots.go1.poses.natnet import _listening_to
from amhe_cli.robots.go1.poses.source import PoseError
from amhe_cli.system.edits import inputs_of_set_const


def test_mujoco_lists_the_inputs_of_its_derived_constants() -> None:
    known = {"body_mass", "body_inertia", "body_ipos", "dof_armature", "qpos0"}
    assert known <= inputs_of_set_const(), f"broken by mujoco {version('mujoco')}"
    assert "pair_friction" not in inputs_of_set_const(), f"broken by mujoco {version('mujoco')}"


def test_a_mujoco_without_that_list_is_refused_in_one_line(monkeypatch) -> None:
    monkeypatch.delattr(mujoco.MjModel, "_setconst_inputs")
    with pytest.raises(AmheError, match=r"mujoco 4\S* lists no inputs of mj_setConst; install"):
        inputs_of_set_const()


def test_the_state_of_cmaes_has_its_names() -> None:
    optimiser = cmaes.CMA(mean=np.zeros(2), sigma=1.0)
    names = ("_mean", "_C", "_sigma", "_p_sigma", "_pc", "_g", "_funhist_values")
    missing = [name for name in names if not hasattr(optimiser, name)]
    assert missing == [], f"broken by cmaes {version('cmaes')}"


def test_natnet_makes_its_sockets_where_we_replace_them() -> None:
    natnet = pytest.importorskip("natnet")
    create = getattr(natnet.NatNetClient, "_NatNetClient__create_socket", None)
    assert create is not None, f"broken by natnet {version('natnet')}"
    assert list(inspect.signature(create).parameters) == ["addr", "port"], f"natnet {version('natnet')}"


def test_a_natnet_that_makes_its_sockets_elsewhere_is_refused() -> None:
    with pytest.raises(PoseError, match="install natnet 0.3"):
        _listening_to("127.0.0.1", type("NatNetClient", (), {}))
