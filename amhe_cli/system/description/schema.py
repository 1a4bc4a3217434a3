"""What a `system.yaml`, or the arguments of `System.from_model`, may contain."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any, Literal, Protocol

from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model, model_validator

from amhe_cli.core.errors import one_of
from amhe_cli.core.mistakes import mistakes
from amhe_cli.core.settings import Settings
from amhe_cli.core.signals import FACTORS, QUANTITIES
from amhe_cli.core.yaml_file import Place

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0)]
NotNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0)]
Name = Annotated[str, Field(min_length=1)]
#: A list of model names, or a mapping from model names to the log's names.
Names = Annotated[list[Name], Field(min_length=1)] | Annotated[dict[Name, Name], Field(min_length=1)]

#: Keys of a signal that say what it is; one of them, or none for a topic that is only read.
KINDS = ("body", "joints", "actuators", "mocap", "force_on", "joint_force", "site", "sensor")


class _Entry(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


#: Quantities that a single `unit:` of a signal is for.
_MOTION = ("position", "velocity", "linear_velocity", "angular_velocity", "value")


class TargetEntry(_Entry):
    """Numbers of the model that one parameter sets; `targets.SETTERS` says what `set` may be."""

    set: str
    body: Name | None = None
    geom: Name | None = None
    pair: Name | Annotated[list[Name], Field(min_length=2, max_length=2)] | None = None
    joint: Name | None = None
    actuator: Name | None = None
    signal: Name | None = None
    quantity: Name | None = None
    axis: Literal["x", "y", "z", "all", "roll", "pitch", "yaw"] | None = None
    mode: Literal["value", "scale", "add"] = "value"
    carry_inertia: bool = True
    carry_limit: bool = False


class ParameterEntry(_Entry):
    """One unknown parameter; what is not given is taken from the model."""

    targets: Annotated[list[TargetEntry], Field(min_length=1)]
    unit: str | None = None
    nominal: Number | None = None
    bounds: tuple[Number, Number] | None = None
    scale: Literal["log", "linear"] | None = None
    prior_sd: NotNegative | None = None
    drift: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0)] | None = None
    group: Name | None = None
    held: Number | None = None
    held_sd: NotNegative = 0.0


class SignalEntry(_Entry):
    """One topic, and how it relates to the model."""

    topic: str
    type: Name | None = None
    body: Name | None = None
    joints: Names | None = None
    actuators: Names | None = None
    mocap: Name | None = None
    force_on: Name | None = None
    joint_force: Names | None = None
    site: Name | None = None
    sensor: Name | Annotated[list[Name], Field(min_length=1)] | None = None
    quantity: Name | Annotated[list[Name], Field(min_length=1)] | None = None
    noise: dict[str, Positive | None] = Field(default_factory=dict)
    compare: list[Name] | None = None
    slope: dict[str, Positive] = Field(default_factory=dict)
    fields: dict[str, Name | list[Name]] = Field(default_factory=dict)
    columns: dict[str, Name | int | list[Name | int]] = Field(default_factory=dict)
    child_frame: Name | None = None
    offset: Number = 0.0
    frame: Literal["world", "body"] | Annotated[list[Number], Field(min_length=6, max_length=6)] | None = None
    at: Name | None = None
    reaction: bool = False
    scale: Positive | dict[str, Positive] | None = None
    bias: dict[str, Number | list[Number]] = Field(default_factory=dict)
    band: Positive | None = None
    smooth: Positive | None = None
    unit: Name | dict[str, Name] | None = None
    wraps: bool = False
    reversed: list[Name] = Field(default_factory=list)
    hold: bool = True
    active: list[tuple[Number, Number]] | Annotated[dict[Name, Number], Field(min_length=1)] | None = None

    @property
    def kind(self) -> str | None:
        """Which of KINDS it is."""
        return next((kind for kind in KINDS if getattr(self, kind) is not None), None)

    @model_validator(mode="before")
    @classmethod
    def _topic_or_columns(cls, data: Any) -> Any:
        """Columns of a table need no topic; everything else does."""
        return {"topic": "", **data} if isinstance(data, Mapping) and "columns" in data else data

    @model_validator(mode="after")
    def _one_kind(self) -> SignalEntry:
        given = [kind for kind in KINDS if getattr(self, kind) is not None]
        if len(given) > 1:
            raise ValueError(f"a signal is one thing; keep one of: {', '.join(given)}")
        quantities = [self.quantity] if isinstance(self.quantity, str) else self.quantity or []
        units = self.unit if isinstance(self.unit, dict) else {}
        for name in (*self.noise, *self.fields, *self.columns, *self.slope, *units, *quantities):
            if name not in QUANTITIES:
                raise ValueError(one_of("quantity", name, QUANTITIES))
        for name in self.slope:
            if not name.endswith("velocity"):
                raise ValueError(f"{name} is no velocity, and has no slope of its own")
        for name in [self.unit] if isinstance(self.unit, str) else (self.unit or {}).values():
            if name not in FACTORS:
                raise ValueError(one_of("unit", name, FACTORS))
        if self.wraps and self.joints is None:
            raise ValueError("wraps is for joints: their encoders jump by a turn")
        own = self.joints or self.actuators or self.joint_force or ()
        for name in self.reversed:
            if name not in own:
                raise ValueError(one_of("joint or actuator of the signal", name, list(own)))
        if not self.hold and self.actuators is None and self.joint_force is None and self.force_on is None:
            raise ValueError("hold is for what drives the model: actuators, joint_force, force_on")
        for name in self.compare or ():
            if self.noise.get(name) is None:
                raise ValueError(f"{name} cannot be compared without its noise; add it to noise: {{...}}")
        return self

    @property
    def factors(self) -> dict[str, float]:
        """Quantity -> factor from the unit of the log's file to SI; one unit is for all that move."""
        given = dict.fromkeys(_MOTION, self.unit) if isinstance(self.unit, str) else self.unit or {}
        return {quantity: FACTORS[unit] for quantity, unit in given.items()}

    def compares(self, quantity: str) -> bool:
        """Whether rollouts are held against this quantity; noise alone bounds a first state's error too."""
        return self.noise.get(quantity) is not None and (self.compare is None or quantity in self.compare)


class SystemEntry(_Entry):
    """A whole `system.yaml`."""

    model: Name
    keyframe: Name | None = None
    boxes: dict[Name, Annotated[list[Positive], Field(min_length=3, max_length=3)]] = Field(
        default_factory=dict
    )
    parameters: Annotated[dict[Name, ParameterEntry], Field(min_length=1)]
    signals: Annotated[dict[Name, SignalEntry], Field(min_length=1)]
    unknowns: Annotated[list[Name], Field(min_length=1)] | None = None
    match: Literal["motion", "effort", "both"] = "motion"
    robot: Literal["go1"] | None = None  # the rooms of robots/ that have settings of their own
    settings: Settings = Settings()

    @model_validator(mode="before")
    @classmethod
    def _leave_to_robot(cls, data: Any) -> Any:
        """Settings of the robot are checked where the robot is known: here they are left out."""
        if not isinstance(data, dict) or not isinstance(data.get("settings"), Mapping):
            return data
        others = set(robot_groups(data)) - set(type(cls.model_fields["settings"].default).model_fields)
        general = {key: value for key, value in data["settings"].items() if key not in others}
        return data | {"settings": general}


def robot_groups(data: Mapping[str, Any]) -> tuple[str, ...]:
    """Groups of settings that belong to the robot of a system's description; none where it has no robot."""
    robot = data.get("robot")
    return ("control", robot) if isinstance(robot, str) else ()


class _Remaining(SystemEntry):
    """What is left without the wrong entries: perhaps no parameters, perhaps no signals."""

    parameters: dict[Name, ParameterEntry] = Field(default_factory=dict)
    signals: dict[Name, SignalEntry] = Field(default_factory=dict)


#: Keys whose shape is best explained by an example.
_EXAMPLES = {
    "noise": "a mapping such as {position: 0.002}",
    "columns": "a mapping such as {position: [q1, q2]} or {position: 'q*'}",
    "fields": "a mapping such as {position: ['motor[0].q', 'motor[1].q']}",
    "bounds": "[lower, upper]",
    "frame": "world, body, or [x, y, z, roll, pitch, yaw]",
    "scale": "a number above 0, or a mapping such as {force: 1.02}",
    "bias": "a mapping such as {force: [0.1, 0, 0]}",
    "active": "times such as [[0.5, 3.0]], or a signal and its value such as {torque_on: 1}",
    "length": "[shortest, longest]",
}


class Description(Protocol):
    """A system in words: a file or arguments. It keeps the mistakes that are found in it."""

    data: dict[str, Any]

    def problem(self, place: Place, text: str, at_key: bool = False) -> None:
        """Note a mistake at the value, or key, that `place` names."""

    def raise_problems(self) -> None:
        """Raise one ConfigError that lists every noted mistake, a line each."""


@cache
def with_settings(entry: type[SystemEntry], schema: type[Settings]) -> type[SystemEntry]:
    """A kind of entry with other settings, such as those of a robot."""
    return create_model(entry.__name__, __base__=entry, settings=(schema, schema()))


def validated(file: Description, schema: type[Settings] = Settings) -> SystemEntry | None:
    """The content of a description; mistakes are noted there, and the entries that have one are left out.

    Returns:
        What remains without the wrong entries, so that its names can still be checked against the
        model; None where too little remains.
    """
    whole = with_settings(SystemEntry, schema)
    try:
        return whole.model_validate(file.data)
    except ValidationError as error:
        found = [*mistakes(error, whole, file.data, _EXAMPLES)]
    remaining = {k: dict(v) if isinstance(v, Mapping) else v for k, v in file.data.items()}
    for place, text, at_key in found:
        file.problem(place, text, at_key)
        group = remaining.get(str(place[0])) if place else None
        if len(place) > 1 and isinstance(group, dict):
            group.pop(place[1], None)
        elif place:
            remaining.pop(str(place[0]), None)
    try:
        return with_settings(_Remaining, schema).model_validate(remaining)
    except ValidationError:
        return None
