"""A wheeled robot's bag, identified as a stranger would: one command, no system folder.

    python benchmarks/rover.py [--seeds 8] [--jobs 2]

Two driven wheels and a caster; joint states, odometry and wheel speeds of 24 s in a rosbag2. What is wrong in
the model is drawn from the prior that `amhe init` gives it. Counts 90 % intervals that hold the truth.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from common import over_seeds, seeds_of, show
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

from amhe_cli.cli.main import run

STEP, SECONDS = 0.002, 24.0
WHEELS = ("left_wheel_joint", "right_wheel_joint")
WHEEL = """<body name="{side}_wheel" pos=".08 {y} -.02">
<joint name="{side}_wheel_joint" axis="0 1 0" damping=".01" armature=".002" frictionloss=".01"/>
<geom type="cylinder" size=".06 .015" zaxis="0 1 0" mass=".2"/></body>"""
MODEL = f"""<mujoco model="rover"><option timestep="{STEP}"/><worldbody>
<geom name="floor" type="plane" size="20 20 .1"/>
<body name="base" pos="0 0 .08"><freejoint/><geom name="hull" type="box" size=".15 .1 .04" mass="3"/>
<geom name="caster" type="sphere" size=".03" pos="-.13 0 -.05" mass=".1" priority="1" friction="0.05"/>
{WHEEL.format(side="left", y=0.13)}{WHEEL.format(side="right", y=-0.13)}</body></worldbody><actuator>
<velocity name="left_motor" joint="left_wheel_joint" kv=".5"/>
<velocity name="right_motor" joint="right_wheel_joint" kv=".5"/></actuator></mujoco>"""


def truth(rng: np.random.Generator) -> dict[str, float]:
    """Numbers of the robot, from the prior of what its model says."""
    drawn = {"base_mass": 3.1 * np.exp(0.3 * rng.standard_normal())}
    for wheel in WHEELS:
        for name, value in {"damping": 0.01, "armature": 0.002, "friction_loss": 0.01}.items():
            drawn[f"{wheel}_{name}"] = value * np.exp(0.5 * rng.standard_normal())
    return drawn | {"left_wheel_mass": 0.2, "right_wheel_mass": 0.2}


def drive(path: Path, numbers: dict[str, float], rng: np.random.Generator) -> None:
    """Write the bag of one drive."""
    spec = mujoco.MjSpec.from_string(MODEL)
    spec.geom("hull").mass = numbers["base_mass"] - 0.1
    for wheel in WHEELS:
        joint = spec.joint(wheel)
        joint.damping[0] = numbers[f"{wheel}_damping"]
        joint.armature, joint.frictionloss = (numbers[f"{wheel}_{n}"] for n in ("armature", "friction_loss"))
    model = spec.compile()
    data, types = mujoco.MjData(model), get_typestore(Stores.ROS2_HUMBLE)
    kind = {name.rsplit("/", 1)[1]: types.types[name] for name in types.types}
    mujoco.mj_step(model, data, 500)
    with Writer(path, version=9) as bag:
        topics = {
            name: bag.add_connection(topic, kind[name].__msgtype__, typestore=types)
            for name, topic in {
                "JointState": "/joint_states",
                "Odometry": "/odom",
                "Float64MultiArray": "/wheel_controller/commands",
            }.items()
        }

        def write(message: Any, stamp: int) -> None:
            name = type(message).__name__.rsplit("__", 1)[1]
            bag.write(topics[name], stamp, types.serialize_cdr(message, message.__msgtype__))

        for k in range(round(SECONDS / STEP)):
            stamp = 1_700_000_000_000_000_000 + round(k * STEP * 1e9)
            if k % 250 == 0:
                data.ctrl[:] = rng.uniform(-6.0, 8.0, 2)
            if k % 25 == 0:
                layout = kind["MultiArrayLayout"](dim=[], data_offset=0)
                write(kind["Float64MultiArray"](layout=layout, data=data.ctrl.copy()), stamp)
            if k % 10 == 0:
                for message in measured(data, kind, stamp, rng):
                    write(message, stamp)
            mujoco.mj_step(model, data)


def measured(data: mujoco.MjData, kind: dict[str, Any], stamp: int, rng: np.random.Generator) -> list[Any]:
    """Joint states and odometry, with the noise of their sensors."""
    time = kind["Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    turned, body, n = np.zeros(9), np.zeros(3), rng.normal
    mujoco.mju_quat2Mat(turned, data.qpos[3:7])
    mujoco.mju_mulMatTVec3(body, turned, data.qvel[:3])
    w, x, y, z = data.qpos[3:7] + n(0, 1e-3, 4)
    vector, unknown = kind["Vector3"], np.zeros(36)
    joints = kind["JointState"](
        header=kind["Header"](stamp=time, frame_id=""),
        name=list(WHEELS),
        position=data.qpos[7:9] + n(0, 1e-3, 2),
        velocity=data.qvel[6:8] + n(0, 0.02, 2),
        effort=np.zeros(0),
    )
    pose = kind["Pose"](
        position=kind["Point"](*(data.qpos[:3] + n(0, 1e-3, 3))),
        orientation=kind["Quaternion"](x=x, y=y, z=z, w=w),
    )
    linear, angular = vector(*(body + n(0, 0.01, 3))), vector(*(data.qvel[3:6] + n(0, 0.01, 3)))
    odometry = kind["Odometry"](
        header=kind["Header"](stamp=time, frame_id="odom"),
        child_frame_id="base",
        pose=kind["PoseWithCovariance"](pose=pose, covariance=unknown),
        twist=kind["TwistWithCovariance"](
            twist=kind["Twist"](linear=linear, angular=angular), covariance=unknown
        ),
    )
    return [joints, odometry]


def trial(seed: int) -> dict[str, Any]:
    """Identify one bag by one command."""
    rng = np.random.default_rng([seed, 37])
    numbers, began = truth(rng), time.process_time()
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        bag, model, out = (Path(folder) / name for name in ("bag", "rover.xml", "out"))
        model.write_text(MODEL)
        drive(bag, numbers, rng)
        run(["identify", str(bag), "--model", str(model), "-o", str(out), "-q", "--threads", "1"])
        found = json.loads((out / "result.json").read_text())
    parameters = {p["name"]: p for p in found["parameters"]}
    rows = {
        name: [numbers[name], p["estimate"], p["lower"], p["upper"], p["verdict"]]
        for name, p in parameters.items()
        if name in numbers
    }
    result = {"misfit": max(found["noise_scale"].values()), "rows": rows, "cpu": time.process_time() - began}
    print(seed, json.dumps(result), flush=True)
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=seeds_of, default=range(8), metavar="N or A:B")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    given = parser.parse_args()
    results = over_seeds("rover", trial, given.seeds, given.jobs)
    table = []
    for name in results[0]["rows"]:
        rows = [result["rows"][name] for result in results]
        held = sum(low < true < high for true, _, low, high, _ in rows)
        off = np.median([abs(estimate / true - 1.0) for true, estimate, *_ in rows])
        claimed = sum(verdict == "identified" for *_, verdict in rows)
        table.append((name, f"{held} of {len(rows)}", f"{off:.1%}", str(claimed)))
    show("90 % intervals hold, median error, identified", ("parameter", "held", "off", "identified"), table)
    print("misfit", [round(r["misfit"], 1) for r in results], "CPU s", [round(r["cpu"]) for r in results])


if __name__ == "__main__":
    main()
