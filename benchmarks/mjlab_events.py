"""Does mjlab take what `amhe export --to mjlab` writes? Run this where mjlab is installed; amhe need not be.

    amhe export result/belief.yaml --to mjlab -o mjlab/
    python benchmarks/mjlab_events.py mjlab/ [--envs 64] [--device cpu]

`identified.xml` becomes a robot of mjlab's scene, and mjlab's event manager draws the events once. Then every
number of the model that an event has changed must lie within a range of that event.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

import argparse
import importlib.util
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import torch
from mjlab.actuator import XmlActuatorCfg
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.managers.event_manager import EventManager
from mjlab.scene import Scene, SceneCfg
from mjlab.sim import Simulation, SimulationCfg

#: Rounding of single precision, as a share.
ROUNDING = 1e-5


def events_of(path: Path) -> dict[str, Any]:
    """The events of an exported file."""
    spec = importlib.util.spec_from_file_location("events", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.identified_events()


def environment(model: Path, envs: int, device: str) -> Any:
    """What events need of an environment: a scene with the model as its robot, and its simulation."""
    own = mujoco.MjSpec.from_file(str(model))
    targets = tuple(actuator.target for actuator in own.actuators)
    actuators = (XmlActuatorCfg(target_names_expr=targets),) if targets else ()
    robot = EntityCfg(
        spec_fn=lambda: mujoco.MjSpec.from_file(str(model)),
        articulation=EntityArticulationInfoCfg(actuators=actuators),
    )
    scene = Scene(SceneCfg(num_envs=envs, entities={"robot": robot}), device)
    sim = Simulation(envs, SimulationCfg(), scene.compile(), device)
    scene.initialize(sim.mj_model, sim.model, sim.data)
    return SimpleNamespace(scene=scene, sim=sim, num_envs=envs, device=device)


def ranges(value: Any) -> Iterator[tuple[float, float]]:
    """All ranges among the arguments of an event."""
    if isinstance(value, dict):
        for one in value.values():
            yield from ranges(one)
    elif isinstance(value, tuple) and all(isinstance(end, float) for end in value):
        yield value


def main() -> None:
    """Draw all events, and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--envs", type=int, default=64)
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    env = environment(options.folder / "identified.xml", options.envs, options.device)
    manager = EventManager(events_of(options.folder / "mjlab_events.py"), env)
    fields = manager.domain_randomization_fields
    env.event_manager = manager
    env.sim.expand_model_fields(fields)
    for name in manager.active_terms["startup"]:
        term = manager.get_term_cfg(name)
        before = {field: getattr(env.sim.model, field).clone() for field in fields}
        term.func(env, None, **term.params)
        after = {field: getattr(env.sim.model, field) for field in fields}
        drawn = torch.cat([after[field][after[field] != before[field]].flatten() for field in fields])
        # both ends of a limit and a servo's bias have the opposite sign
        inside = torch.zeros_like(drawn, dtype=torch.bool)
        for low, high in ranges(term.params):
            slack = ROUNDING * max(abs(low), abs(high))
            inside |= (drawn.abs() >= low - slack) & (drawn.abs() <= high + slack)
        # a whole inertia and a centre of mass move numbers that are in no range
        share = "" if "inertia" in name or "com" in name else f", {int(inside.sum())} of them in its range"
        print(f"{name}: {len(drawn)} numbers drawn{share}")
        assert not share or inside.all()
    manager.apply("startup")
    env.sim.step()
    assert torch.isfinite(env.sim.data.qpos).all()
    print(f"mjlab {version('mjlab')} takes all of them")


if __name__ == "__main__":
    main()
