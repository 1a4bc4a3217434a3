"""Numbers of joints and actuators that MuJoCo keeps but does not use: `<custom><numeric>` of a model.

Those of one element are `<numeric name="PREFIX/ELEMENT" data="..."/>`: part of the model like all others.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import ConfigError
from amhe_cli.system.parameters.edits import Cells


@dataclass(frozen=True, slots=True)
class Numerics:
    """The numbers that elements of one kind may have.

    Args:
        prefix: What the names of their numerics begin with.
        kind: Kind of the elements.
        own: The numbers in their order, each with its value where nothing says otherwise.
        how: Those of them that say how, not how much.
    """

    prefix: str
    kind: mujoco.mjtObj
    own: Mapping[str, float]
    how: Collection[str]

    def rows(self, model: mujoco.MjModel) -> dict[int, list[int]]:
        """Row of an element -> where its numbers are in `numeric_data`, in the order of the elements.

        Raises:
            ConfigError: A numeric has too few or too many numbers, or names no element.
        """
        rows: dict[int, list[int]] = {}
        for number in range(model.nnumeric):
            name = model.numeric(number).name
            if not name.startswith(self.prefix):
                continue
            if model.numeric_size[number] != len(self.own):
                raise ConfigError(
                    f"the numeric {name!r} of the model needs {len(self.own)} numbers: {', '.join(self.own)}"
                )
            row = mujoco.mj_name2id(model, self.kind, name.removeprefix(self.prefix))
            if row < 0:
                kind = self.kind.name.removeprefix("mjOBJ_").lower()
                raise ConfigError(f"the numeric {name!r} of the model names no {kind}")
            first = int(model.numeric_adr[number])
            rows[row] = list(range(first, first + len(self.own)))
        return dict(sorted(rows.items()))

    def acting(self, model: mujoco.MjModel, set_by_parameters: Collection[int]) -> dict[int, list[int]]:
        """As `rows`, of elements of which a number that says how much is not zero, or is set."""

        def acts(at: list[int]) -> bool:
            much = [place for name, place in zip(self.own, at, strict=True) if name not in self.how]
            return bool(model.numeric_data[much].any()) or not set(at).isdisjoint(set_by_parameters)

        return {row: at for row, at in self.rows(model).items() if acts(at)}

    def cells(self, model: mujoco.MjModel, row: int, words: Sequence[str], name: str) -> list[Cells]:
        """Some numbers of an element; none where it has none."""
        at = self.rows(model).get(row)
        order = list(self.own)
        return [
            Cells("numeric_data", at[order.index(word)], name=f"{word} of {name}") for word in words if at
        ]

    def element(self, model: mujoco.MjModel, place: int) -> int | None:
        """Row of the element whose number stands at a place of `numeric_data`; None where it is no such."""
        return next((row for row, at in self.rows(model).items() if place in at), None)

    def add(self, spec: mujoco.MjSpec, names: Collection[str], values: FloatArray | None = None) -> None:
        """Give elements of a spec `own` or the values (k,); those that have numbers keep them."""
        present = {numeric.name: numeric for numeric in spec.numerics}
        for name in (self.prefix + name for name in names):
            if name not in present:
                spec.add_numeric(name=name, size=len(self.own), data=list(self.own.values()))
                present[name] = spec.numerics[-1]
            if values is not None:
                present[name].data = np.asarray(values)
