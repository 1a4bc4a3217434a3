"""What beliefs and logs are about: a system, as far as this room knows it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from amhe_cli.core.parameters import ParameterSpace


class Described(Protocol):
    """What a belief can be about: a system."""

    @property
    def name(self) -> str:
        """Name of the system."""
        ...

    @property
    def space(self) -> ParameterSpace:
        """Parameters of the system that are free."""
        ...

    @property
    def fixed(self) -> Mapping[str, float]:
        """Values of the parameters that are fixed, by name."""
        ...

    @property
    def parts(self) -> Mapping[str, str]:
        """Hash of each part of the model."""
        ...

    @property
    def sets(self) -> Mapping[str, str]:
        """What each parameter, free or fixed, sets in the model, in words."""
        ...
