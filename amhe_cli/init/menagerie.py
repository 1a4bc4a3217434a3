"""Models of the MuJoCo Menagerie by name, where the package mujoco-menagerie is installed."""

from __future__ import annotations

from pathlib import Path

from amhe_cli.core.errors import ConfigError, one_of


def menagerie_names() -> list[str]:
    """Names of the models; none without the package."""
    try:
        import mujoco_menagerie
    except ImportError:
        return []
    return mujoco_menagerie.names()


def menagerie_model(name: str) -> Path:
    """The XML file of a model, which the package downloads on first use.

    Args:
        name: `MODEL`, such as unitree_go2, for its scene with a floor or else the robot alone; `MODEL/FILE`,
            such as unitree_go2/go2, for another file of it.

    Raises:
        ConfigError: The package is not installed, has no such model, or cannot download it.
    """
    try:
        import mujoco_menagerie
    except ImportError:
        raise ConfigError(
            f"menagerie:{name} needs the package mujoco-menagerie: pip install 'amhe[robots]'; or give the "
            "model's XML file in a clone of the MuJoCo Menagerie"
        ) from None
    robot, _, entry = name.partition("/")
    if robot not in menagerie_names():
        raise ConfigError(one_of("model of the menagerie", robot, menagerie_names()))
    try:
        return mujoco_menagerie.get(robot).xml(entry or None)
    except mujoco_menagerie.DownloadError as error:
        folder = mujoco_menagerie.Cache().model_path(mujoco_menagerie.get(robot))
        raise ConfigError(
            f"menagerie:{name}: {error}; offline, copy the folder {folder} from a computer that has it"
        ) from None
    except mujoco_menagerie.MenagerieError as error:
        raise ConfigError(f"menagerie:{name}: {error}") from None
