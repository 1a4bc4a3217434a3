"""How much a file may cost: the work on a hostile file is bounded, and real ones stay far below the bounds.

What is read within `with amhe.limit(topics=10_000):` has that limit in place of its default.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import asdict, dataclass, replace

from amhe_cli.core.errors import ConfigError, one_of


@dataclass(frozen=True, slots=True)
class Limits:
    """The limits, each with what real files need.

    Args:
        piece_mib: A chunk or a message, once unfolded [MiB]; recorders write chunks of 1 to 4 MiB, and the
            largest messages, raw images and point clouds, have 100 MiB.
        growth: All pieces of a log, once unfolded, as a multiple of its size; `piece_mib` is granted in any
            case. Robot logs shrink to a half or a tenth when they are packed.
        topics: Topics of a log; large robots have a thousand.
        messages: Messages of one topic, or rows of a table; two hours at 1 kHz are 7.2 million.
        columns: Columns of all tables of a log; a ULog has some thousand.
        fields: Fields of one topic that are looked at one by one, because its messages differ in layout; a
            message has some hundred, and most topics have one layout.
        definition_mib: The definition of a message type with all that it consists of [MiB]; large ones have
            100 KiB.
        yaml_mib: A YAML file, or a JSON file that describes a dataset [MiB]; a recording of ten thousand
            files has a metadata.yaml of 2 MiB.
        model_mib: A model file [MiB]; large robots have one.
        model_elements: Elements of a model, also copies by <replicate> and <flexcomp>, a body as four; a hand
            has some hundred, a kitchen some thousand.
        model_numbers: Numbers of all height fields, textures and sizes of a model, where its images are not
            large themselves (`growth`); a texture of 4096 x 4096 has 16,800,000.
        model_iterations: Iterations of the solver in a step, each with those of its line search; MuJoCo's
            default is 5,000.
        yaml_values: Values in a YAML file, those that an alias repeats each time; that recording has 100,000.
    """

    piece_mib: int = 256
    growth: int = 100
    topics: int = 5_000
    messages: int = 10_000_000
    columns: int = 100_000
    fields: int = 20_000_000
    model_mib: int = 64
    definition_mib: int = 1
    model_elements: int = 10_000
    model_numbers: int = 25_000_000
    model_iterations: int = 1_000_000
    yaml_mib: int = 4
    yaml_values: int = 130_000

    @property
    def piece(self) -> int:
        """`piece_mib` in bytes."""
        return self.piece_mib * 2**20

    @property
    def yaml(self) -> int:
        """`yaml_mib` in bytes."""
        return self.yaml_mib * 2**20

    @property
    def definition(self) -> int:
        """`definition_mib` in bytes."""
        return self.definition_mib * 2**20


#: The limits that hold where the code runs.
_LIMITS: ContextVar[Limits] = ContextVar("limits", default=Limits())  # noqa: B039 (it is frozen)


def limits() -> Limits:
    """The limits that hold here."""
    return _LIMITS.get()


def beyond(name: str, found: str) -> str:
    """Words for a limit that was reached: its value, and how to raise it.

    Args:
        name: Name of the limit.
        found: What is beyond it, and a verb.
    """
    value = getattr(limits(), name)
    return f"{found} beyond the limit {name} = {value} (`limit` {name}={4 * value} raises it)"


@contextmanager
def limit(**values: int) -> Iterator[None]:
    """Set limits for what is read within the block; for their names see `Limits`.

    Raises:
        ConfigError: There is no such limit, or it is no whole number above zero.
    """
    for name, value in values.items():
        if name not in asdict(limits()):
            raise ConfigError(one_of("limit", name, asdict(limits())))
        if not isinstance(value, int) or value <= 0:
            raise ConfigError(f"limit {name}: {value!r} is no whole number above zero")
    token = _LIMITS.set(replace(limits(), **values))
    try:
        yield
    finally:
        _LIMITS.reset(token)
