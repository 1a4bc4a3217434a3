"""A belief for other tools: models, samples, and randomisation of trainings."""

from __future__ import annotations

import csv
import io
import shutil
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from amhe_cli.api.arguments import checked
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.belief import Belief, completed
from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.core.files import filling
from amhe_cli.engine.cpu import hush_mujoco
from amhe_cli.report.folder import reserve
from amhe_cli.system.description.folders import named_system
from amhe_cli.system.export.loads import WRITERS, load_of, xacro_properties
from amhe_cli.system.export.mjcf import identified_assets, identified_spec, identified_xml
from amhe_cli.system.export.randomisation import randomisation
from amhe_cli.system.export.trainings import ISAACLAB_TOOL, MJLAB_TOOL
from amhe_cli.system.export.urdf import identified_urdf
from amhe_cli.system.model.files import compiled
from amhe_cli.system.system import System

_TRAININGS = {"mjlab": MJLAB_TOOL, "isaaclab": ISAACLAB_TOOL}
#: What a belief can be exported to.
KINDS = ("mjcf", "urdf", "samples", *_TRAININGS, "xacro", *WRITERS)


def export(
    belief: Belief | str | Path,
    to: str,
    out: str | Path,
    *,
    system: System | str | Path | None = None,
    belief_anyway: bool = False,
    urdf: str | Path | None = None,
    flange: str | None = None,
    count: int = 100,
    models: bool = False,
    seed: int = 0,
    force: bool = False,
) -> list[Path]:
    """Write what is believed of a system in a form that another tool takes.

    Args:
        belief: The belief, or the path of a belief.yaml.
        to: 'mjcf': identified.xml; 'urdf': identified.urdf; 'samples': samples.npz and samples.csv, draws of
            the belief that keep its correlations; 'mjlab' or 'isaaclab': a Python file with the belief's
            intervals as randomisation ranges, and the identified model; 'xacro': a file of properties; 'ur',
            'franka' or 'kuka': what hangs on the flange, as these arms take it.
        out: Folder of the files; made if it does not exist.
        system: The system, its name or folder; None: the one that the belief names, if it comes with amhe.
        belief_anyway: Take a belief about another model too, and only warn of what has changed.
        urdf: For 'urdf' and 'isaaclab': a URDF of the robot, whose text is kept but for the values.
        flange: For 'ur', 'franka' and 'kuka': the body that is the flange; it and what hangs on it are the
            load, in its axes.
        count: For 'samples': number of draws.
        models: For 'samples': write an MJCF of each draw too.
        seed: For 'samples': seed of the draws.
        force: Write into a folder that is not empty; other files in it stay.

    Returns:
        The files, without those of meshes.

    Raises:
        ConfigError: An argument is wrong, or the belief does not suit the system.
    """
    hush_mujoco()
    seed, _ = checked(seed, None)
    if to not in KINDS:
        raise ConfigError(f"`to`: {one_of('kind', to, KINDS)}")
    if not (isinstance(count, int) and count > 0):
        raise ConfigError(f"`count`: {count!r} is no whole number of 1 or more")
    read = belief if isinstance(belief, Belief) else Belief.load(belief)
    source = "the belief" if isinstance(belief, Belief) else str(belief)
    opened, given = system_of(read, source, system).starting_from(belief, belief_anyway=belief_anyway)
    assert given is not None, "a belief was given"
    known, folder = completed(given, opened), reserve(Path(out), "export", force)
    if to == "samples":
        contents = _samples(opened, known, count, models, seed)
    else:
        contents = _values(opened, known, to, None if urdf is None else Path(urdf), flange)
    _write(folder, opened, contents)
    return [folder / name for name in contents]


def _values(
    system: System, belief: Belief, to: str, urdf: Path | None, flange: str | None
) -> dict[str, str | FloatArray]:
    """File -> content: the estimate in a model or a load, and what a training draws from."""
    if to in WRITERS:
        if flange is None:
            raise ConfigError("`flange`: name the body whose load is written")
        file, text = WRITERS[to]
        return {file: text(*load_of(compiled(identified_spec(system, belief.estimate)), flange))}
    if to == "xacro":
        return {"identified.xacro": xacro_properties(system, belief.estimate)}
    if to == "urdf" and urdf is None:
        raise ConfigError("`urdf`: give the URDF that the values are written into, or take mjcf")
    model: dict[str, str | FloatArray] = (
        {"identified.urdf": identified_urdf(system, belief.estimate, urdf)}
        if urdf is not None and to in ("urdf", "isaaclab")
        else {"identified.xml": identified_xml(system, belief.estimate)}
    )
    tool = _TRAININGS.get(to)
    return model | ({f"{to}_events.py": randomisation(system, belief, tool)} if tool else {})


def system_of(belief: Belief, source: str, system: System | str | Path | None) -> System:
    """The user's choice of a system, or else the bundled one that a belief names.

    Args:
        belief: The belief.
        source: Its file, or what else to call it in an error.
        system: The user's choice; None: there is none.

    Raises:
        ConfigError: There is no such system, or the belief is about one of the user's.
    """
    if isinstance(system, System):
        return system
    own = belief.provenance.get("system_folder")
    chosen = system or named_system(belief.system, source, None if own is None else str(own))
    return System.load(chosen, warn=False)


def _samples(
    system: System, belief: Belief, count: int, models: bool, seed: int
) -> dict[str, str | FloatArray]:
    """Draws within the bounds of the search, one line and, on demand, one model each."""
    draws = np.empty((0, len(belief.names)))
    low, high = zip(*((p.lower, p.upper) for p in system.space.parameters), strict=True)
    rng = np.random.default_rng(seed)
    while len(draws) < count:
        more = belief.sample(count, rng)
        draws = np.concatenate((draws, more[np.all((more >= low) & (more <= high), axis=1)]))
    draws = draws[:count]
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(belief.names)
    table.writerows([f"{value:.9g}" for value in row] for row in draws)
    files: dict[str, str | FloatArray] = {"samples.csv": text.getvalue(), "samples.npz": draws}
    if models:
        files |= {f"sample_{i:04d}.xml": identified_xml(system, row) for i, row in enumerate(draws)}
    return files


def _write(folder: Path, system: System, contents: Mapping[str, str | FloatArray]) -> None:
    """Write all files, and the models' meshes beside them, or none."""
    with filling(folder) as scratch:
        for name, content in contents.items():
            if isinstance(content, str):
                (scratch / name).write_text(content, encoding="utf-8")
            else:
                np.savez(scratch / name, samples=content, names=np.array(system.space.names))
        text = "".join(content for content in contents.values() if isinstance(content, str))
        for name, source in identified_assets(system).items():
            if name in text and source.is_file():
                (scratch / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(source, scratch / name)
