"""The few messages of ROS 2 that are read or written here, as DDS knows them (package `cyclonedds`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


def pose_types() -> tuple[Any, Any]:
    """PoseStamped and Odometry."""
    from cyclonedds.idl.types import array, float64  # pyright: ignore[reportMissingImports]

    header, spread = _header(), array[float64, 36]
    point = _struct("geometry_msgs/Point", x=float64, y=float64, z=float64)
    turn = _struct("geometry_msgs/Quaternion", x=float64, y=float64, z=float64, w=float64)
    pose = _struct("geometry_msgs/Pose", position=point, orientation=turn)
    vector = _struct("geometry_msgs/Vector3", x=float64, y=float64, z=float64)
    twist = _struct("geometry_msgs/Twist", linear=vector, angular=vector)
    posed = _struct("geometry_msgs/PoseWithCovariance", pose=pose, covariance=spread)
    twisted = _struct("geometry_msgs/TwistWithCovariance", twist=twist, covariance=spread)
    return (
        _struct("geometry_msgs/PoseStamped", header=header, pose=pose),
        _struct("nav_msgs/Odometry", header=header, child_frame_id=str, pose=posed, twist=twisted),
    )


def joint_state_type() -> Any:
    """JointState, which every viewer plots by name."""
    from cyclonedds.idl.types import float64, sequence  # pyright: ignore[reportMissingImports]

    numbers = sequence[float64]
    return _struct(
        "sensor_msgs/JointState",
        header=_header(), name=sequence[str], position=numbers, velocity=numbers, effort=numbers,
    )  # fmt: skip


def headed(kind: Any, seconds: float, **fields: Any) -> Any:
    """A message with a header.

    Args:
        kind: Type of the message.
        seconds: Stamp of the header, on ROS's clock [s].
        fields: All other fields.
    """
    header = kind.__annotations__["header"]
    stamp = header.__annotations__["stamp"](int(seconds), int(1e9 * (seconds % 1.0)))
    return kind(header=header(stamp, ""), **fields)


def _header() -> Any:
    from cyclonedds.idl.types import int32, uint32  # pyright: ignore[reportMissingImports]

    stamp = _struct("builtin_interfaces/Time", sec=int32, nanosec=uint32)
    return _struct("std_msgs/Header", stamp=stamp, frame_id=str)


def _struct(name: str, /, **fields: Any) -> Any:
    from cyclonedds.idl import IdlStruct  # pyright: ignore[reportMissingImports]

    package, message = name.split("/")
    made = type(
        message + "_",
        (IdlStruct,),
        {"__annotations__": fields},
        typename=f"{package}::msg::dds_::{message}_",
    )
    return dataclass(made)
