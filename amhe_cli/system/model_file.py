"""Model files, MJCF or URDF, with MuJoCo's errors and warnings in our words."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from weakref import WeakKeyDictionary

import mujoco
import numpy as np

from amhe_cli.core.errors import ConfigError

logger = logging.getLogger(__name__)


def read_spec(path: Path) -> mujoco.MjSpec:
    """Read a model file; the fixed links of a URDF stay bodies that parameters can name.

    Raises:
        ConfigError: MuJoCo cannot read it.
    """
    with _in_our_words(f"MuJoCo cannot read {path.name!r}"):
        spec = mujoco.MjSpec.from_file(str(path.absolute()))  # its meshes are found from any folder
    if path.suffix.lower() == ".urdf":
        spec.compiler.fusestatic = False
    return spec


def spec_of(model: mujoco.MjModel | mujoco.MjSpec | str | Path) -> mujoco.MjSpec:
    """A spec of a model that the caller may change: read from its MJCF or URDF file, or copied.

    MuJoCo keeps the source of a compiled model only of the XML that was loaded last; the numbers of such a
    spec have six digits.

    Raises:
        ConfigError: The file cannot be read, or the source of the compiled model is lost.
    """
    if isinstance(model, mujoco.MjModel):
        return _source_of(model)
    if not isinstance(model, str | Path):
        return model.copy()
    if not Path(model).is_file():
        raise ConfigError(f"`model`: there is no file {str(model)!r}; give an MJCF or a URDF")
    return read_spec(Path(model))


#: Sources of compiled models that were given before: MuJoCo has lost them as soon as it loads another model.
_SOURCES: WeakKeyDictionary[mujoco.MjModel, mujoco.MjSpec] = WeakKeyDictionary()


def _source_of(model: mujoco.MjModel) -> mujoco.MjSpec:
    if model in _SOURCES:
        return _SOURCES[model].copy()
    try:
        with TemporaryDirectory() as folder:
            path = Path(folder) / "model.xml"
            mujoco.mj_saveLastXML(str(path), model)
            spec = mujoco.MjSpec.from_file(str(path))
            again = spec.compile()
    except (ValueError, mujoco.FatalError):
        again = None
    if again is None or again.names != model.names or not np.allclose(again.qpos0, model.qpos0, atol=1e-4):
        raise ConfigError(
            "`model`: MuJoCo no longer has the source of this MjModel; give the MjSpec or the XML file that "
            "it was made from"
        )
    _SOURCES[model] = spec
    return spec.copy()


def compiled(spec: mujoco.MjSpec, name: str = "the model") -> mujoco.MjModel:
    """Compile a spec; its elements then know their rows in the model.

    Args:
        spec: The spec to compile.
        name: Name of the model in error messages.

    Raises:
        ConfigError: MuJoCo cannot compile it.
    """
    with _in_our_words(f"MuJoCo cannot compile {name}"):
        return spec.compile()


@contextmanager
def _in_our_words(what: str) -> Iterator[None]:
    """Turn errors into ConfigErrors, and warnings into log lines."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            yield
        except (ValueError, mujoco.FatalError) as error:
            raise ConfigError(f"{what}: {' '.join(str(error).split())}") from None
    for text in dict.fromkeys(" ".join(str(warning.message).split()) for warning in caught):
        logger.warning("MuJoCo: %s", text)
