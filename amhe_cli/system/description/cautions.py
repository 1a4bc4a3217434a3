"""Warnings about models whose simulation does not do what the user expects, each of one line."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import mujoco

from amhe_cli.core.errors import ConfigError, and_more
from amhe_cli.system.parameters.contacts import geom_name, partners
from amhe_cli.system.parameters.edits import Cells
from amhe_cli.system.parameters.model_edits import ModelEdits

logger = logging.getLogger(__name__)

#: Factor between the nominal number and the model's own from which one of them is probably a mistake.
FAR = 20.0
#: Contact dimension that a friction column needs: sliding, torsional, rolling.
_NEEDED = (3, 4, 6)
#: Names of the columns of a friction, in the order of `_NEEDED`.
_WORDS = ("sliding", "torsional", "rolling")


def caution(where: str, model: mujoco.MjModel, edits: ModelEdits) -> None:
    """Warn of a solver known to be wrong, and of parameters without effect in all or part of their range.

    Args:
        where: Name of the system's file, for the warnings.
        model: The base model.
        edits: The parameters and what they set.
    """
    newton = model.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON
    if mujoco.__version__ == "4.0.0" and newton and mujoco.mj_isSparse(model):  # 4.0.1 mended it
        logger.warning(
            f"{where}: the Newton solver of MuJoCo {mujoco.__version__} is wrong if the constraint Jacobian "
            "is sparse, as in this model (mujoco issue 3767): update MuJoCo, or write "
            '<option jacobian="dense"/> into the model'
        )
    found = [
        (parameter.name, text)
        for parameter, cells in edits.by_parameter()
        for part in cells
        for text in _texts(model, part, cells, parameter.lower)
    ]
    for name, text in dict.fromkeys((*found, *_far_from_the_model(model, edits))):
        line = f"{where}: parameter {name!r}: {text}"
        logger.warning(line)


def _far_from_the_model(model: mujoco.MjModel, edits: ModelEdits) -> Iterator[tuple[str, str]]:
    """Positive numbers that start far from the model's own, and those of joints that a factor leaves at 0."""
    try:
        started = edits.apply(model, edits.space.nominal)
    except ConfigError:  # said where it is simulated
        return
    for parameter, cells in edits.by_parameter():
        pairs = [(float(part.of(model)[0]), float(part.of(started)[0])) for part in cells]
        own, nominal = max(pairs, key=lambda pair: _apart(*pair), default=(1.0, 1.0))
        if parameter.log and _apart(own, nominal) > FAR:
            yield parameter.name, f"starts at {nominal:.3g}, where the model's own number is {own:.3g}"
        dofs = [part.row for part in cells if part.field.startswith("dof_") and not part.of(started).any()]
        if parameter.log and dofs:
            names = and_more([model.joint(int(model.dof_jntid[row])).name for row in dofs], 3)
            yield parameter.name, f"a factor leaves at 0 what {names} has none of: give a nominal of its own"


def _apart(own: float, nominal: float) -> float:
    """Factor between two positive numbers; 1 where one is not."""
    return max(own / nominal, nominal / own) if min(own, nominal) > 0.0 else 1.0


def _texts(model: mujoco.MjModel, part: Cells, cells: tuple[Cells, ...], lower: float) -> Iterator[str]:
    if part.field == "geom_friction":
        yield from _geom_friction(model, part, cells, lower)
    elif part.field == "pair_friction":
        yield from _dimension(
            part, int(model.pair_dim[part.row]), f"pair {model.pair(part.row).name!r}", pair=True
        )
    elif part.field in ("geom_solref", "pair_solref") and part.columns == (0,):
        shortest = 2.0 * model.opt.timestep
        if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE and lower < shortest:
            yield f"a contact time constant below two time steps, {shortest:g} s, acts as {shortest:g} s"


def _geom_friction(
    model: mujoco.MjModel, part: Cells, cells: tuple[Cells, ...], lower: float
) -> Iterator[str]:
    """Contact friction is the element-wise maximum of both geoms, unless their priorities differ."""
    row, column = part.row, part.columns[0]
    name = geom_name(model, row)
    if not (model.geom_contype[row] or model.geom_conaffinity[row]):
        yield f"{name} collides only through contact pairs, which have their own friction: target the pair"
        return
    together = {c.row for c in cells if c.field == "geom_friction"}
    others = list(partners(model, row))
    if model.geom_bodyid[row] == 0 and together & set(others):  # a floor whose partners are set, too
        others = [other for other in others if other in together]
    for other in others:
        if other in together or model.geom_priority[other] < model.geom_priority[row]:
            continue
        if model.geom_priority[other] > model.geom_priority[row]:
            yield f"{name} touches {geom_name(model, other)}, whose higher priority decides the friction"
        elif model.geom_friction[other, column] > lower:
            yield (
                f"below {model.geom_friction[other, column]:g} it changes nothing against "
                f"{geom_name(model, other)}: the larger friction of both geoms counts; use a contact pair, "
                f"or a higher priority"
            )
    dimensions = [int(model.geom_condim[row]), *(int(model.geom_condim[other]) for other in others)]
    yield from _dimension(part, max(dimensions), name)


def _dimension(part: Cells, dimension: int, name: str, pair: bool = False) -> Iterator[str]:
    index = (0, 0, 1, 2, 2)[part.columns[0]] if pair else part.columns[0]
    if dimension < _NEEDED[index]:
        yield f"{name} has condim {dimension}; {_WORDS[index]} friction acts from condim {_NEEDED[index]}"
