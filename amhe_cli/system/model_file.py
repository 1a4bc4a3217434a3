"""Model files, MJCF or URDF, with MuJoCo's complaints in our words."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import mujoco

from amhe_cli.core.errors import ConfigError

logger = logging.getLogger(__name__)


def read_spec(path: Path) -> mujoco.MjSpec:
    """Read a model file; the fixed links of a URDF stay bodies that parameters can name.

    Raises:
        ConfigError: MuJoCo cannot read it.
    """
    with _in_our_words(f"MuJoCo cannot read {path.name!r}"):
        spec = mujoco.MjSpec.from_file(str(path))
    if path.suffix.lower() == ".urdf":
        spec.compiler.fusestatic = False
    return spec


def compiled(spec: mujoco.MjSpec, name: str = "the model") -> mujoco.MjModel:
    """Compile a spec; its elements then know their rows in the model.

    Args:
        spec: To compile.
        name: For complaints.

    Raises:
        ConfigError: MuJoCo cannot compile it.
    """
    with _in_our_words(f"MuJoCo cannot compile {name}"):
        return spec.compile()


@contextmanager
def _in_our_words(what: str) -> Iterator[None]:
    """Errors as ConfigError, warnings as log lines."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            yield
        except (ValueError, mujoco.FatalError) as error:
            raise ConfigError(f"{what}: {' '.join(str(error).split())}") from None
    for text in dict.fromkeys(" ".join(str(warning.message).split()) for warning in said):
        logger.warning("MuJoCo: %s", text)
