"""Opening the engine of a system, and the same engine on variants of the system's model."""

from __future__ import annotations

import copy
import logging
from concurrent.futures import Executor

import mujoco
import numpy as np

from amhe_cli.core.errors import NOTE, ConfigError, SimulationError
from amhe_cli.engine.auto import AutoEngine, Opening, in_background
from amhe_cli.engine.cpu import CpuEngine
from amhe_cli.engine.gpu.engine import GpuEngine, compile_apart
from amhe_cli.engine.gpu.visible import look_for_cards, visible_cards
from amhe_cli.engine.inverse import InverseEngine
from amhe_cli.engine.rollout import Engine
from amhe_cli.engine.spread import SpreadEngine
from amhe_cli.engine.states import collides
from amhe_cli.system.parameters.model_edits import ModelEdits
from amhe_cli.system.system import System

logger = logging.getLogger(__name__)

#: Kinds of engine that can be opened.
KINDS = ("cpu", "gpu", "auto")


def open_engine(
    system: System,
    *,
    threads: int = 1,
    executor: Executor | None = None,
    kind: str = "cpu",
    sensors: bool | None = None,
    model: mujoco.MjModel | None = None,
) -> Engine:
    """An engine for the rollouts of a system.

    Args:
        threads: Number of CPU threads; results do not depend on it.
        executor: Executor whose workers compute the rollouts, instead of threads of this process; it must
            stay open.
        kind: One of `KINDS`; 'auto' decides for each call, by its rollouts and their lengths.
        sensors: Whether rollouts record sensors; None: if the system needs them.
        model: Roll out this model of the same layout; None: the system's own.

    Raises:
        ConfigError: There is no such kind of engine, or it cannot use workers.
        SimulationError: This computer has no card or lacks its libraries, or the model does not suit.
    """
    check_kind(kind)
    senses = system.senses if sensors is None else sensors
    edits = system.edits if model is None else system.edits.upon(model)
    about = (model or system.model, edits, system.input_spec)
    if system.match == "effort":
        return InverseEngine(*about)
    if kind == "gpu":
        return _gpu_engine(executor, *about, senses)
    if executor is not None:
        return SpreadEngine(executor, *about, senses)
    cpu = CpuEngine(*about, threads, senses)
    if kind == "cpu":
        return cpu
    try:
        look_for_cards()
    except SimulationError as error:
        logger.log(NOTE, "the CPU computes all rollouts: %s", str(error).partition(";")[0])
        return cpu

    def loaded(count: int) -> Engine:
        engine = _gpu_engine(None, *about, senses, beside=(count, threads))
        engine.load(count, threads)
        return engine

    opening = Opening(lambda count: in_background(lambda: loaded(count)))
    engine = AutoEngine(cpu, opening, opening.opened, about[0], threads)
    logger.log(
        NOTE, "the graphics card, where it is quicker: calls of %.0f equally long rollouts or more; "
        "else the CPU", engine.fewest,
    )  # fmt: skip
    return engine


def check_kind(kind: str) -> None:
    """Refuse a kind of engine that does not exist.

    Raises:
        ConfigError: There is no such kind of engine; the text lists all.
    """
    if kind not in KINDS:
        raise ConfigError(f"no engine {kind!r}; there is: {', '.join(KINDS)}")


def _gpu_engine(
    executor: Executor | None,
    model: mujoco.MjModel,
    edits: ModelEdits,
    input_spec: int,
    sensors: bool,
    beside: tuple[int, int] | None = None,
) -> GpuEngine:
    """The engine on all cards of this computer.

    Args:
        executor: Must be None.
        model, edits, input_spec, sensors: See `GpuEngine`.
        beside: Rollouts of a call, and threads that compile its kernels first, beside other work; None: they
            compile when they are needed.

    Raises:
        ConfigError: Workers were requested.
        SimulationError: mujoco-warp or a card is missing, or it cannot simulate the model.
    """
    if executor is not None:
        raise ConfigError("the engine 'gpu' computes on the cards of this computer; leave `workers` out")
    about = model, edits, input_spec, sensors, visible_cards()
    try:
        if beside:
            compile_apart(about, *beside)
        return GpuEngine(*about)
    except ImportError as error:
        raise SimulationError(
            f"the engine 'gpu' needs {error.name}, which is not installed: pip install 'amhe[gpu]'"
        ) from None


def contact_variants(engine: Engine, model: mujoco.MjModel) -> dict[str, Engine]:
    """The same engine on a model's contact variants: details that nobody measured are changed.

    The time constant of MuJoCo's soft contacts is a numerical choice as much as a material: an estimate
    that follows it absorbs errors of the contact model.

    Args:
        model: Model of the engine.

    Returns:
        Name of the variant -> its engine; empty for a model that cannot collide.
    """
    if not collides(model):
        return {}
    return {
        "contacts twice as soft": engine.upon(_with_time_constant(model, 2.0)),
        "contacts twice as hard": engine.upon(_with_time_constant(model, 0.5)),
    }


def _with_time_constant(model: mujoco.MjModel, factor: float) -> mujoco.MjModel:
    """A copy with every positive solref time constant scaled, not below two time steps."""
    changed = copy.copy(model)
    for solref in (changed.geom_solref, changed.pair_solref):
        soft = solref[:, 0] > 0.0
        solref[soft, 0] = np.maximum(factor * solref[soft, 0], 2.0 * model.opt.timestep)
    return changed


def finer_step(engine: Engine, model: mujoco.MjModel) -> tuple[Engine, int]:
    """The same engine on a model of half the time step, and the order of the integrator's error in it."""
    changed = copy.copy(model)
    changed.opt.timestep *= 0.5
    return engine.upon(changed), 4 if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4 else 1


def finer_solver(engine: Engine, model: mujoco.MjModel) -> Engine | None:
    """The same engine with a solver that goes on for longer; None for a model without constraints."""
    limited = model.jnt_limited.any() or model.tendon_limited.any()
    constrained = limited or model.dof_frictionloss.any() or model.neq or collides(model)
    if not constrained:
        return None
    changed = copy.copy(model)
    changed.opt.iterations *= 10
    changed.opt.ls_iterations *= 10
    changed.opt.tolerance *= 1e-3
    return engine.upon(changed)
