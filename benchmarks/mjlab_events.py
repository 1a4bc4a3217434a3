"""Does mjlab take what `amhe export --to mjlab` writes? Run this where mjlab is installed; amhe need not be.

    amhe export result/belief.yaml --to mjlab -o mjlab/
    python benchmarks/mjlab_events.py mjlab/ [--envs 64] [--device cpu]

`identified.xml` becomes a robot of mjlab's scene, once with the actuators of the MJCF and, where the file has
them, once with `identified_actuators`. mjlab's event manager draws the events. Every number of the model that
an event has changed must lie within a range of that event, and half a second is simulated. Undrawn, joints
move under `identified_actuators` as under those of the MJCF whose targets come late, each environment by a
lag of its own that stays; friction of gears and back-EMF, which the MJCF only keeps, make a difference.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

import argparse
import runpy
from collections.abc import Iterator, Sequence
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
#: How far targets leap [rad], and after how many steps: mjlab delays nothing before its buffers are full.
LEAP, FIRST = 0.1, 50


def names_of(path: Path) -> dict[str, Any]:
    """The names of a Python file."""
    return runpy.run_path(str(path))


def environment(model: Path, envs: int, device: str, actuators: Sequence[Any] = ()) -> Any:
    """What events need of an environment: a scene with the model as its robot, and its simulation.

    Its actuators are those of the MJCF where none are given.
    """

    def made() -> mujoco.MjSpec:
        spec = mujoco.MjSpec.from_file(str(model))
        for actuator in spec.actuators if actuators else ():
            spec.delete(actuator)
        return spec

    targets = tuple(actuator.target for actuator in mujoco.MjSpec.from_file(str(model)).actuators)
    own = (XmlActuatorCfg(target_names_expr=targets),) if targets else ()
    robot = EntityCfg(spec_fn=made, articulation=EntityArticulationInfoCfg(actuators=tuple(actuators) or own))
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


def draw(env: Any, events: dict[str, Any]) -> None:
    """Draw all events in an environment, and print a line for each."""
    manager = EventManager(events, env)
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


def moved(env: Any, late: torch.Tensor, seconds: float = 0.5) -> torch.Tensor:
    """Joint positions (steps, envs, joints) where all targets leap by LEAP, `late` [steps] by environment."""
    robot, found = env.scene["robot"], []
    for step in range(round(seconds / env.sim.mj_model.opt.timestep)):
        leap = LEAP * (step >= FIRST + late).float()[:, None]
        robot.set_joint_position_target(robot.data.default_joint_pos + leap)
        env.scene.write_data_to_sim()
        env.sim.step()
        env.scene.update(env.sim.mj_model.opt.timestep)
        found.append(robot.data.joint_pos.clone())
    found = torch.stack(found)
    assert torch.isfinite(found).all()
    return found


def compare(model: Path, actuators: Sequence[Any], device: str, envs: int) -> None:
    """Print how `identified_actuators` differ from those of the MJCF, each of whose targets has one lag."""
    longest = max(actuator.delay_max_lag for actuator in actuators)
    own = moved(environment(model, longest + 1, device), torch.arange(longest + 1, device=device))
    theirs = moved(environment(model, envs, device, actuators), torch.zeros(envs, device=device))
    apart = (theirs[:, :, None] - own[:, None]).abs().amax(dim=(0, 3))
    least, lags = apart.min(dim=1)
    print(
        f"identified_actuators: {len(actuators)} servos, late by {lags.min()} to {lags.max()} steps; at most "
        f"{least.max():.1e} rad from those of the MJCF with targets as late, of {own.abs().max():.2f} rad"
    )


def main() -> None:
    """Draw and step what `amhe export` wrote."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--envs", type=int, default=64)
    parser.add_argument("--device", default="cpu")
    given = parser.parse_args()
    names, model = names_of(given.folder / "mjlab_events.py"), given.folder / "identified.xml"
    made = names.get("identified_actuators", lambda timestep: ())(SimulationCfg().mujoco.timestep)
    if made:
        compare(model, made, given.device, given.envs)
    for actuators in ((), made) if made else ((),):
        env = environment(model, given.envs, given.device, actuators)
        draw(env, names["identified_events"]())
        moved(env, torch.zeros(given.envs, device=given.device))
    print(f"mjlab {version('mjlab')} takes all of them")


if __name__ == "__main__":
    main()
