"""A simulated arm of one joint that publishes as a robot with ROS 2 does; it needs no ROS.

    python examples/ros2_arm.py &
    amhe watch --system pendulum --source ros2 --set live.interface=127.0.0.1

A payload is put on it after ten seconds. Its joint states come at 500 Hz with the sensors' noise, and up to
3 ms late, over DDS, Zenoh or UDP; with --unitree over DDS as those of a Unitree robot: /lowstate, /lowcmd.
"""

from __future__ import annotations

import argparse
import atexit
import json
import socket
import time
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from amhe_cli.logs.messages.definitions import Definitions
from amhe_cli.system.system import System

TRUTH = {"load_mass": 0.4, "damping": 0.03, "friction_loss": 0.035, "armature": 0.006}
STATE, STATE_HZ, COMMAND_HZ = "sensor_msgs/msg/JointState", 500, 100
POSITION_NOISE, VELOCITY_NOISE, JITTER = 0.002, 0.05, 0.003  # sd [rad], sd [rad/s], longest delay [s]
FINER = 4  # steps of the simulation in one step of the model that is estimated


def main() -> None:
    """Simulate in real time, and publish."""
    chosen = arguments()
    send = sender_of(chosen)
    rng = np.random.default_rng(chosen.seed)
    system = System.load("pendulum")
    model = system.edits.apply(system.model, np.array([TRUTH[name] for name in system.space.names]))
    model.opt.timestep /= FINER
    data = mujoco.MjData(model)
    rates = (round(1.0 / hz / model.opt.timestep) for hz in (STATE_HZ, COMMAND_HZ))
    (per_state, per_command), loaded = rates, False
    begun, step, target = time.time(), 0, excitation(rng)
    while data.time < chosen.seconds:
        if not loaded and data.time >= chosen.at:
            loaded = True
            model.body("load").mass[0] += chosen.payload
            mujoco.mj_setConst(model, data)
            print(f"{chosen.payload:g} kg put on at {begun + data.time:.3f}", flush=True)
        stamp = begun + data.time
        if step % per_command == 0:
            data.ctrl[0] = target(data.time)
            send("/joint_commands", stamp, data.ctrl, [])
        if step % per_state == 0:
            time.sleep(max(0.0, stamp + rng.uniform(0.0, JITTER) - time.time()))
            position = data.qpos + rng.normal(0.0, POSITION_NOISE)
            send("/joint_states", stamp, position, data.qvel + rng.normal(0.0, VELOCITY_NOISE))
        mujoco.mj_step(model, data)
        step += 1


def arguments() -> argparse.Namespace:
    """Of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--transport", choices=("dds", "zenoh", "udp"), default="dds")
    parser.add_argument("--unitree", action="store_true", help="dds: motor 0 of a Unitree robot")
    parser.add_argument("--domain", type=int, default=0)
    parser.add_argument("--connect", default="tcp/localhost:7447", help="zenoh: the router")
    parser.add_argument("--port", type=int, default=9870, help="udp")
    parser.add_argument("--payload", type=float, default=0.8, help="[kg]")
    parser.add_argument("--at", type=float, default=10.0, help="when it is put on [s]")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    return parser.parse_args()


def excitation(rng: np.random.Generator) -> Callable[[float], float]:
    """A position command [rad] over time [s]: a multisine from slow (friction) to fast (inertia)."""
    hertz = np.geomspace(0.15, 2.5, 6)
    phase = rng.uniform(0.0, 2.0 * np.pi, 6)
    size = 0.9 / np.sqrt(hertz / hertz[0]) / 2.0
    return lambda t: float((size * (np.sin(2.0 * np.pi * hertz * t + phase) - np.sin(phase))).sum())


def sender_of(chosen: argparse.Namespace) -> Callable[[str, float, Any, Any], None]:
    """Sends a joint state on a topic: stamp [s], position, velocity."""
    if chosen.transport == "udp":
        out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

        def send_line(topic: str, stamp: float, position: Any, velocity: Any) -> None:
            message = {"topic": topic, "stamp": stamp, "name": ["hinge"]}
            message |= {"position": list(position), "velocity": list(velocity)}
            out.sendto(json.dumps(message).encode(), ("127.0.0.1", chosen.port))

        return send_line
    if chosen.transport == "zenoh":
        from amhe_cli.logs.live.ros import Zenoh

        transport: Any = Zenoh((), Definitions(), chosen.domain, chosen.connect)
    else:
        from amhe_cli.logs.live.ros import Dds

        transport = Dds((), Definitions(), chosen.domain, "127.0.0.1", ())
    atexit.register(transport.close)
    if chosen.unitree:
        return unitree(transport)
    store = get_typestore(Stores.LATEST)
    kinds = store.types

    def send(topic: str, stamp: float, position: Any, velocity: Any) -> None:
        seconds, rest = divmod(round(stamp * 1e9), 10**9)
        at = kinds["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
        message = kinds[STATE](
            header=kinds["std_msgs/msg/Header"](stamp=at, frame_id=""), name=["hinge"],
            position=np.array(position, dtype=np.float64), velocity=np.array(velocity, dtype=np.float64),
            effort=np.zeros(0),
        )  # fmt: skip
        transport.publish(topic, STATE, bytes(store.serialize_cdr(message, STATE)))

    return send


def zeros(store: Any, kind: str) -> Any:
    """A message of zeros, of a type that a store of rosbags knows."""
    values = {}
    for name, (node, detail) in store.fielddefs[kind][1]:
        element, size = detail if node == Nodetype.ARRAY else ((node, detail), 0)
        plain = element[0] == Nodetype.BASE
        if size:
            number = element[1][0]
            values[name] = (
                np.zeros(size, number) if plain else [zeros(store, element[1]) for _ in range(size)]
            )
        else:
            values[name] = 0 if plain else zeros(store, element[1])
    return store.types[kind](**values)


def unitree(transport: Any) -> Callable[[str, float, Any, Any], None]:
    """Sends state and command of a Unitree robot's first motor; they have no stamp."""
    store = get_typestore(Stores.EMPTY)
    for kind in ("LowState", "LowCmd"):
        name = f"unitree_go/msg/{kind}"
        store.register(get_types_from_msg(Definitions().described(name)[0], name))

    state, command = (zeros(store, f"unitree_go/msg/{kind}") for kind in ("LowState", "LowCmd"))

    def send(topic: str, stamp: float, position: Any, velocity: Any) -> None:
        if topic == "/joint_states":
            state.motor_state[0].q, state.motor_state[0].dq = float(position[0]), float(velocity[0])
            state.tick = round(1e3 * stamp) % 2**32
            message, topic = state, "/lowstate"
        else:
            command.motor_cmd[0].q = float(position[0])
            message, topic = command, "/lowcmd"
        kind = type(message).__msgtype__
        transport.publish(topic, kind, bytes(store.serialize_cdr(message, kind)))

    return send


if __name__ == "__main__":
    main()
