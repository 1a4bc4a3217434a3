"""Where the message types of robotics keep the quantities of `amhe_cli.core.signals`.

A type that is not here is read through the paths of `Signal.fields`, in the same way.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

_XYZ = ("x", "y", "z")
#: ROS stores quaternions as x, y, z, w; picking the columns in our order converts them.
_WXYZ = ("w", "x", "y", "z")


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


def _plain(twist_in_child: bool = False, unknown: Mapping[str, str] | None = None, **at: str) -> TypeInfo:
    columns = {q: _WXYZ if q == "orientation" else _XYZ for q in at}
    fields = {q: tuple(f"{at[q]}.{c}" for c in columns[q]) for q in at}
    return TypeInfo(fields, columns, twist_in_child=twist_in_child, unknown=unknown)


def _pose(at: str) -> TypeInfo:
    return _plain(position=f"{at}.position", orientation=f"{at}.orientation")


def _transform(at: str = "", elements: str | None = None) -> TypeInfo:
    """A translation and a rotation at a path; of each of `elements` where there are several."""
    head = f"{at}." if at else ""
    info = _plain(position=f"{head}translation", orientation=f"{head}rotation")
    return TypeInfo(info.fields, info.columns, elements=elements)


def _twist(at: str) -> TypeInfo:
    return _plain(linear_velocity=f"{at}.linear", angular_velocity=f"{at}.angular")


_NUMBERS = TypeInfo({"value": ("data",)}, {})
_JOINT_STATE = TypeInfo(
    {"position": ("position",), "velocity": ("velocity",), "effort": ("effort",)}, {}, names="name"
)
_JOINT_TRAJECTORY = TypeInfo(
    {"position": ("positions",), "velocity": ("velocities",), "effort": ("effort",)},
    {},
    names="joint_names",
    elements="points",
)

TYPES: Mapping[str, TypeInfo] = {
    "sensor_msgs/msg/JointState": _JOINT_STATE,
    "trajectory_msgs/msg/JointTrajectory": _JOINT_TRAJECTORY,
    "nav_msgs/msg/Odometry": _plain(
        position="pose.pose.position",
        orientation="pose.pose.orientation",
        linear_velocity="twist.twist.linear",
        angular_velocity="twist.twist.angular",
        twist_in_child=True,
    ),
    "geometry_msgs/msg/Pose": _plain(position="position", orientation="orientation"),
    "geometry_msgs/msg/PoseStamped": _pose("pose"),
    "geometry_msgs/msg/PoseWithCovarianceStamped": _pose("pose.pose"),
    "geometry_msgs/msg/PointStamped": _plain(position="point"),
    "geometry_msgs/msg/TransformStamped": _transform("transform"),
    "tf2_msgs/msg/TFMessage": _transform("transform", elements="transforms"),
    "tf/msg/tfMessage": _transform("transform", elements="transforms"),
    "geometry_msgs/msg/Twist": _plain(linear_velocity="linear", angular_velocity="angular"),
    "geometry_msgs/msg/TwistStamped": _twist("twist"),
    "geometry_msgs/msg/TwistWithCovarianceStamped": _twist("twist.twist"),
    "geometry_msgs/msg/Wrench": _plain(force="force", torque="torque"),
    "geometry_msgs/msg/WrenchStamped": _plain(force="wrench.force", torque="wrench.torque"),
    "sensor_msgs/msg/Imu": _plain(
        orientation="orientation",
        angular_velocity="angular_velocity",
        linear_acceleration="linear_acceleration",
        unknown={
            "orientation": "orientation_covariance[0]",
            "angular_velocity": "angular_velocity_covariance[0]",
            "linear_acceleration": "linear_acceleration_covariance[0]",
        },
    ),
    **{
        f"{package}{name}": info
        for package in ("foxglove.", "foxglove_msgs/msg/")
        for name, info in {
            "SceneUpdate": TypeInfo({}, {}),  # what 3-D panels draw: thousands of corners, no measurement
            "Imu": _plain(
                orientation="orientation",
                angular_velocity="angular_velocity",
                linear_acceleration="linear_acceleration",
            ),
            "Pose": _plain(position="position", orientation="orientation"),
            "PoseInFrame": _pose("pose"),
            "FrameTransform": _transform(),
            "FrameTransforms": _transform(elements="transforms"),
            "JointState": _JOINT_STATE,
            "JointStates": _JOINT_STATE,
            "Odometry": _plain(
                position="pose.position",
                orientation="pose.orientation",
                linear_velocity="linear_velocity",
                angular_velocity="angular_velocity",
                twist_in_child=True,
            ),
        }.items()
    },
    **{
        f"std_msgs/msg/{name}": _NUMBERS
        for width in ("Float32", "Float64", "Int8", "Int16", "Int32", "Int64", "UInt8", "UInt16", "UInt32")
        for name in (width, f"{width}MultiArray")
    },
}
