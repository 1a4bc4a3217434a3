"""A system: the model, its unknowns, and how logged signals meet the model's state."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco

from amhe_cli.core.belief import Belief, belief_for
from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.core.log import Log
from amhe_cli.core.settings import Settings
from amhe_cli.core.shown import Displayed
from amhe_cli.core.signals import remapped
from amhe_cli.core.yaml_file import merged
from amhe_cli.system.description.data import SystemData
from amhe_cli.system.description.doubts import doubts_of
from amhe_cli.system.description.load import described, load, matched
from amhe_cli.system.model.urdf import UrdfOptions
from amhe_cli.system.parameters.identity import parts_of, sets_of


class System(SystemData, Displayed):
    """A model, its unknown parameters, and how logged signals relate to it; `SystemData` has its fields."""

    @classmethod
    def load(
        cls,
        name_or_folder: str | Path,
        settings: Mapping[str, Any] | None = None,
        *,
        schema: type[Settings] = Settings,
        warn: bool = True,
    ) -> System:
        """Read, check and compile a system folder.

        Args:
            name_or_folder: A folder with a `system.yaml`, or the name of a bundled system.
            settings: Nested settings such as `{"clips": {"count": 40}}` in place of the folder's own;
                `parameters`, `signals`, `keyframe` and `boxes` replace those parts of `system.yaml`.
            schema: Class of the settings. A robot has its own with more groups; without it, the groups of the
                system's robot are not checked.
            warn: Log what is allowed but will not do what it seems to.

        Raises:
            ConfigError: One line for each mistake, `file:line:column: what, what would be valid`.
        """
        made = load(name_or_folder, settings, schema, warn=warn)
        return cls(**vars(made))

    @classmethod
    def from_model(
        cls,
        model: mujoco.MjSpec | str | Path,
        *,
        parameters: Mapping[str, Any],
        signals: Mapping[str, Any],
        settings: Mapping[str, Any] | Settings | None = None,
        keyframe: str | None = None,
        match: str = "motion",
        name: str | None = None,
        packages: Mapping[str, str | Path] | None = None,
        meshes: bool = True,
        warn: bool = True,
    ) -> System:
        """Make a system from a model and plain dictionaries; no folder and no YAML is needed.

        Args:
            model: Path of an MJCF or URDF file, or an MjSpec, which is copied.
            parameters: Name -> entry with the keys that `parameters` has in `system.yaml`.
            signals: Name -> entry likewise; `topic` may be left out.
            settings: Nested settings over the defaults.
            keyframe: Name of the keyframe that holds the state of everything that no signal gives.
            match: What is compared with the logs: the 'motion' under what drives it, the 'effort' of the
                joints along their motion, or 'both'.
            name: Name of the system; None: that of the model.
            packages: Folders of the ROS packages that a URDF's meshes lie in, by name; others are looked for
                in the folders above the URDF.
            meshes: Use the meshes of a URDF; else boxes of the same mass and inertia take their place.
            warn: Log what is allowed but will not do what it seems to.

        Raises:
            ConfigError: One line for each mistake, `path.of.the.key: what, what would be valid`.
        """
        entry = {"parameters": parameters, "signals": signals, "settings": settings or {}, "match": match}
        entry |= {"keyframe": keyframe} if keyframe else {}
        made = described(model, entry, name, UrdfOptions(packages or {}, meshes), warn=warn)
        return cls(**vars(made))

    def matching(self, what: str) -> System:
        """The system with something else compared with its logs; see `match` of `from_model`."""
        made = matched(self, what)
        return System(**vars(made)).fixing({n: v for n, v in self.fixed.items() if n in made.space.names})

    def __repr__(self) -> str:
        signals = ", ".join(signal.name for signal in self.signals)
        return f"System({self.name!r}: parameters {', '.join(self.space.names)}; signals {signals})"

    def __getstate__(self) -> dict[str, Any]:
        """For another process: without MuJoCo's specs, which cannot be pickled; rollouts need none."""
        return {name: value for name, value in vars(self).items() if name not in ("spec", "original")}

    @property
    def dt(self) -> float:
        """Time step of the model [s]: the clock that logs are read onto."""
        return float(self.model.opt.timestep)

    @property
    def unedited(self) -> mujoco.MjModel:
        """The model with its own numbers, upon which edits write: a value that scales them is in it once."""
        return self.edits.own(self.model)

    @property
    def widths(self) -> dict[str, int]:
        """Number of columns of each series, `signal.quantity`, that meets the model."""
        return {part.key: len(part.columns) for part in (*self.channels, *self.inputs)}

    @property
    def units(self) -> dict[str, tuple[str, ...]]:
        """Unit of each series that meets the model; of each column where joints turn and others slide."""
        measured = {one.key: one.units for one in self.channels if one.kind == "linear"}
        return measured | {one.key: one.units for one in self.inputs if one.units}

    def reading(self, topics: Mapping[str, str]) -> System:
        """The system with some of its signals read from other topics.

        Args:
            topics: Name of a signal -> topic.

        Raises:
            ConfigError: There is no such signal.
        """
        given = merged(self.given, {"signals": {name: {"topic": topic} for name, topic in topics.items()}})
        return replace(self, signals=remapped(self.signals, topics), given=given if topics else self.given)

    @property
    def keys(self) -> tuple[str, ...]:
        """Series that every window needs: what the channels measure, and the inputs."""
        return (*(c.key for c in self.channels), *(key for driving in self.inputs for key in driving.keys))

    @property
    def fixed(self) -> dict[str, float]:
        """Values of the fixed parameters, by name: those with the prior sd 0, and those of `fixing`."""
        return self.edits.fixed

    def fixing(
        self,
        fix: Mapping[str, float] | None = None,
        only: Sequence[str] | None = None,
        at: Belief | None = None,
    ) -> System:
        """The system with some of its parameters fixed: they stay in the model and are not estimated.

        Args:
            fix: Parameter -> its value.
            only: Parameters that stay free, by names or patterns such as 'left_*'; all others are fixed.
                None: all that are not in `fix` stay free.
            at: Belief with the values of those that `only` fixes; None: at their nominal values.

        Raises:
            ConfigError: There is no such parameter, a value is outside its bounds, or none is left free.
        """
        fix = dict(fix or {})
        for name, value in fix.items():
            self._check_value(name, value)
        if only is not None:
            values = self.space.named(self.space.nominal)
            values |= zip(at.names, map(float, at.estimate), strict=True) if at else ()
            kept = self._matching(only, fix)
            fix |= {name: values[name] for name in self.space.names if name not in (*kept, *fix)}
        if not fix:
            return self
        edits = self.edits.fixing(fix)
        if not len(edits.space):
            raise ConfigError("every parameter is fixed: leave one free")
        space = self.space.without(fix)
        return replace(self, space=space, edits=edits, model=edits.apply(self.model, space.nominal))

    def starting_from(
        self,
        belief: Belief | str | Path | None,
        *,
        fix: Mapping[str, float] | None = None,
        only: Sequence[str] | None = None,
        belief_anyway: bool = False,
    ) -> tuple[System, Belief | None]:
        """The system with some parameters fixed, see `fixing`, and a belief about the others.

        Args:
            belief: The belief, or the path of its file; None: there is none.
            fix, only: See `fixing`; `only` fixes parameters at the belief's values.
            belief_anyway: Take a belief about another model too, and only warn of what has changed.

        Raises:
            ConfigError: The belief does not suit, or a parameter cannot be fixed so.
        """
        start = None if belief is None else belief_for(self, belief, belief_anyway)
        system = self.fixing(fix, only, start)
        return system, start if start is None else belief_for(system, start)

    def _check_value(self, name: str, value: object) -> None:
        free = {p.name: p for p in self.space.parameters}
        if name not in free and name not in self.sets:
            raise ConfigError(f"`fix`: {one_of('parameter', name, self.sets)}")
        p = free.get(name)
        if not isinstance(value, float | int) or (p is not None and not p.lower <= value <= p.upper):
            valid = f"; between {p.lower:g} and {p.upper:g} would be valid" if p else ""
            raise ConfigError(f"`fix`: {name} cannot be {value}{valid}")

    def _matching(self, only: Sequence[str], fix: Collection[str]) -> list[str]:
        """Names of free parameters that names or patterns mean."""
        if isinstance(only, str):
            raise ConfigError(f"`only`: give a list of names, not {only!r}")
        matches = [[name for name in self.space.names if fnmatchcase(name, pattern)] for pattern in only]
        for pattern, names in zip(only, matches, strict=True):
            if not names:
                raise ConfigError(f"`only`: {one_of('parameter', pattern, self.space.names)}")
            if set(names) <= set(fix):
                raise ConfigError(f"`only`: {pattern} is fixed too (`fix`); leave out one of them")
        return [name for names in matches for name in names]

    @property
    def parts(self) -> dict[str, str]:
        """Hash of each part of the model, without the parameters' values: the same in any folder."""
        return self._about[0]

    @property
    def sets(self) -> dict[str, str]:
        """What each parameter, free or fixed, sets in the model, in words."""
        return self._about[1]

    @cached_property
    def _about(self) -> tuple[dict[str, str], dict[str, str]]:
        return parts_of(self.model, self.edits), sets_of(self.model, self.edits)

    def doubts(self, log: Log) -> list[str]:
        """What in a log contradicts the model or itself, a line each: units, and velocities.

        Args:
            log: A log that was read for this system.
        """
        return [str(doubt) for doubt in doubts_of(self, log)]

    @property
    def senses(self) -> bool:
        """Whether a channel is predicted by a sensor of the model, not by its state alone."""
        return any(channel.source == "sensordata" for channel in self.channels)
