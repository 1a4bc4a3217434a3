"""Where the message types of robotics keep the quantities of `amhe_cli.core.signals`.

A type that is not here is read through the paths of `Signal.fields`, in the same way.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

_XYZ = ("x", "y", "z")
#: ROS stores quaternions as x, y, z, w; picking the columns in our order converts them.
_WXYZ = ("w", "x", "y", "z")

#: Types whose messages have no stamp but a counter of milliseconds, `tick`.
TICKS = ("unitree_go/msg/LowState", "unitree_hg/msg/LowState")


@dataclass(frozen=True, slots=True)
class TypeInfo:
    """How one message type is read.

    Args:
        fields: quantity -> paths of its columns; a path to an array stands for all its elements.
        columns: quantity -> names of these columns, where they are fixed.
        names: Path of the array of names that says which element belongs to which joint; its quantities
            are then picked from arrays by name.
        elements: Path of the array whose elements are messages of their own ('transforms', 'points').
        twist_in_child: The twist is given in the child frame, not in the world.
        unknown: quantity -> path of a number that is -1 where the sender does not know the quantity.
    """

    fields: Mapping[str, tuple[str, ...]]
    columns: Mapping[str, tuple[str, ...]]
    names: str | None = None
    elements: str | None = None
    twist_in_child: bool = False
    unknown: Mapping[str, str] | None = None


def _at(twist_in_child: bool = False, elements: str | None = None, **at: str) -> TypeInfo:
    """Vectors and quaternions at paths, of each of `elements` where there are several."""
    columns = {q: _WXYZ if q == "orientation" else _XYZ for q in at}
    fields = {q: tuple(f"{at[q]}.{c}" for c in columns[q]) for q in at}
    return TypeInfo(fields, columns, elements=elements, twist_in_child=twist_in_child)


def _pose(at: str) -> TypeInfo:
    return _at(position=f"{at}.position", orientation=f"{at}.orientation")


def _transform(at: str = "", elements: str | None = None) -> TypeInfo:
    return _at(elements=elements, position=f"{at}translation", orientation=f"{at}rotation")


_POINT_POSE = _at(position="position", orientation="orientation")
_IMU = _at(
    orientation="orientation", angular_velocity="angular_velocity", linear_acceleration="linear_acceleration"
)
_JOINTS = {"position": ("position",), "velocity": ("velocity",), "effort": ("effort",)}
_JOINT_STATE = TypeInfo(_JOINTS, {}, names="name")
_POINTS = {"position": ("positions",), "velocity": ("velocities",), "effort": ("effort",)}
_FOXGLOVE = {
    "SceneUpdate": TypeInfo({}, {}),  # what 3-D panels draw: thousands of corners, no measurement
    "Imu": _IMU,
    "Pose": _POINT_POSE,
    "PoseInFrame": _pose("pose"),
    "FrameTransform": _transform(),
    "FrameTransforms": _transform(elements="transforms"),
    "JointState": _JOINT_STATE,
    "JointStates": _JOINT_STATE,
    "Odometry": _at(
        position="pose.position", orientation="pose.orientation",
        linear_velocity="linear_velocity", angular_velocity="angular_velocity", twist_in_child=True,
    ),
}  # fmt: skip

TYPES: Mapping[str, TypeInfo] = {
    "sensor_msgs/msg/JointState": _JOINT_STATE,
    "trajectory_msgs/msg/JointTrajectory": TypeInfo(_POINTS, {}, names="joint_names", elements="points"),
    "nav_msgs/msg/Odometry": _at(
        position="pose.pose.position", orientation="pose.pose.orientation",
        linear_velocity="twist.twist.linear", angular_velocity="twist.twist.angular", twist_in_child=True,
    ),
    "geometry_msgs/msg/Pose": _POINT_POSE,
    "geometry_msgs/msg/PoseStamped": _pose("pose"),
    "geometry_msgs/msg/PoseWithCovarianceStamped": _pose("pose.pose"),
    "geometry_msgs/msg/PointStamped": _at(position="point"),
    "geometry_msgs/msg/TransformStamped": _transform("transform."),
    "tf2_msgs/msg/TFMessage": _transform("transform.", "transforms"),
    "tf/msg/tfMessage": _transform("transform.", "transforms"),
    "geometry_msgs/msg/Twist": _at(linear_velocity="linear", angular_velocity="angular"),
    "geometry_msgs/msg/TwistStamped": _at(linear_velocity="twist.linear", angular_velocity="twist.angular"),
    "geometry_msgs/msg/TwistWithCovarianceStamped": _at(
        linear_velocity="twist.twist.linear", angular_velocity="twist.twist.angular"
    ),
    "geometry_msgs/msg/Wrench": _at(force="force", torque="torque"),
    "geometry_msgs/msg/WrenchStamped": _at(force="wrench.force", torque="wrench.torque"),
    "sensor_msgs/msg/Imu": replace(_IMU, unknown={q: f"{q}_covariance[0]" for q in _IMU.fields}),
    **{f"foxglove.{name}": info for name, info in _FOXGLOVE.items()},
    **{f"foxglove_msgs/msg/{name}": info for name, info in _FOXGLOVE.items()},
    **{
        f"std_msgs/msg/{name}": TypeInfo({"value": ("data",)}, {})
        for width in ("Float32", "Float64", "Int8", "Int16", "Int32", "Int64", "UInt8", "UInt16", "UInt32")
        for name in (width, f"{width}MultiArray")
    },
}  # fmt: skip
