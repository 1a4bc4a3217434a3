"""Every setting that a user can change, with its default, unit and reason.

Precedence: command-line option, environment `AMHE_*`, `--config FILE`, the system's own `settings:`,
the default here.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator


def _ordered(pair: tuple[float, float]) -> tuple[float, float]:
    if pair[0] > pair[1]:
        raise ValueError(f"[{pair[0]:g}, {pair[1]:g}] is the wrong way round; write the lower number first")
    return pair


Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)]
Range = Annotated[tuple[Positive, Positive], AfterValidator(_ordered)]


class SettingsGroup(BaseModel):
    """A group of settings; keys that it does not have are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class LogSettings(SettingsGroup):
    """How the topics of a recording become a log on the clock of the model."""

    stamp: Literal["auto", "header", "publish", "log"] = "auto"
    """Which clock to trust; auto takes header stamps where they are set and monotone, and the recorder's for
    all topics where one header clock steps against it."""
    max_gap: Positive = 0.2
    """Longest silence [s] of a topic that is interpolated; a longer one is a gap, never bridged. A topic
    slower than this is allowed five of its own median periods."""
    align: bool = False
    """Correct the estimated clock offsets between topics; they are reported in any case."""
    spikes: Literal["drop", "keep"] = "drop"
    """Single samples of a motion that leap out of it and back: no motion explains them."""
    repeats: Literal["drop", "keep"] = "drop"
    """Values that a bus repeats because the sensor is slower: the first of them is the measurement."""


class ClipSettings(SettingsGroup):
    """The stretches of log that are rolled out (the paper's clips, section III-B)."""

    length: Range = (0.3, 2.0)
    """Clip lengths [s], drawn uniformly; capped by the log's own length."""
    count: Annotated[int, Field(ge=1)] = 24
    """Clips in one iteration, re-drawn for the next; fewer where they would cover the logs twice."""
    held_out: Share = 0.25
    """Share of the logs' time kept for validation when no held-out log is given."""
    held_out_length: Positive | None = None
    """Length [s] of a validation clip; the mean of `length` where not given."""
    held_out_least: Annotated[int, Field(ge=0)] = 0
    """Logs too short for so many validation clips are first fitted without them, then whole."""
    held_out_first_only: bool = False
    """Validate only on each held-out log's first clip instead of tiling it."""
    still: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 3.0
    """A clip is motionless, and dropped, when its motion stays within this many noise sd."""

    @property
    def most(self) -> int:
        """Clips side by side that are fitted, and that are validated on, at most."""
        return 6 * self.count


class CostSettings(SettingsGroup):
    """The rollout-matching cost."""

    huber: Positive = 3.0
    """Residuals beyond this many sd count linearly, not squared (pseudo-Huber)."""
    trim: Share = 0.1
    """Share of worst clips left out of the mean: chaotic contacts and impacts of unknown cause."""
    smoothing: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    """Start rollouts from positions smoothed over this time [s] before and after, not as recorded: for motion
    without impacts there, or where the mean over many windows counts."""


class AssumedSettings(SettingsGroup):
    """How far numbers of the model that are no parameters may be off (sd): what a data sheet is worth.

    Where such a number acts in the rollouts, estimates are widened by what it would do to them. 0: it was
    measured, and is exact; `assumed: 0` says so of all, as for logs of a simulation of the model itself.
    """

    gain: Share = 0.1
    """Gain of an actuator, as a share of it."""
    force_limit: Share = 0.2
    """Limit of an actuator's or a joint's force, as a share of it."""
    ctrl_limit: Share = 0.2
    """Limit of an actuator's control, as a share of it."""
    joint_limit: Share = 0.01
    """Either end of a joint's range, as a share of the range."""
    center_of_mass: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.01
    """Centre of mass of a body whose mass is a parameter, along each axis [m]."""
    mass: Share = 0.1
    """Masses and inertias of the moving bodies whose mass is no parameter, all together, as a share."""
    force_bias: Share = 0.05
    """Bias of a force or torque sensor that is compared, along each axis, as a share of its largest value."""
    damping: Share = 0.3
    """Viscous friction of a joint, as a share of it."""
    armature: Share = 0.2
    """Inertia of a joint's rotor and gears, as a share of it."""
    friction_loss: Share = 0.3
    """Dry friction of a joint, as a share of it."""
    stiffness: Share = 0.1
    """Stiffness of a joint's spring, as a share of it."""
    load_friction: Share = 0.2
    """How much of a geared joint's load its dry friction may grow by, where it does not in the model."""
    stribeck: Share = 0.5
    """How much larger a geared joint's dry friction may be at rest, as a share of it."""
    spring: Share = 0.03
    """Stiffness that a geared joint may have besides the model's, as its cables give it: torque at one radian
    as a share of gravity's largest one."""
    geometry: Share = 0.01
    """Distance from one joint to the next, as a share of it."""
    gravity: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.01
    """Tilt of a fixed base about each horizontal axis [rad]."""
    contacts: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.5
    """Time constant of soft contacts, in factors of two: 1 is twice as soft, or twice as hard."""
    solver: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)] = 1.0
    """How much of what a solver that goes on for longer would change counts as an sd."""
    command_delay: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.005
    """Delay with which commands act, where the model has none [s]."""
    time_step: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)] = 1.0
    """How much of the way from the model's time step to a step of zero counts as an sd. 1: all of it, as for
    logs of the real world. 0: the logs come from a simulation with the model's own step and integrator."""

    @model_validator(mode="before")
    @classmethod
    def _all_exact(cls, given: Any) -> Any:
        """`assumed: 0` is 0 for each."""
        return dict.fromkeys(cls.model_fields, 0.0) if given == 0 and given is not False else given


class IdentifySettings(SettingsGroup):
    """SPI: offline identification over all clips."""

    samples: Annotated[int, Field(ge=4)] = 16
    """Candidates of one iteration; the linearised method takes two for each unknown of a clip if that is
    more."""
    iterations: Annotated[int, Field(ge=1)] = 16
    """Iterations of the linearised method."""
    polish: Annotated[int, Field(ge=1)] = 6
    """Of these, at most so many on fixed clips at the end; those before draw random clips, where things touch
    or logs are long."""
    cmaes_iterations: Annotated[int, Field(ge=1)] = 40
    """Iterations of CMA-ES."""
    first_state: Literal["always", "polish", "never"] = "always"
    """When to treat each clip's first-state errors as nuisances with the sensors' noise as prior;
    polish: only in the last iterations and for the uncertainty, where they are many and clips are dear."""
    step: Annotated[float, Field(gt=0, le=1)] = 0.05
    """Least sampling sd where residuals jitter, as behind chaotic contact, as a share of the parameter:
    smaller steps measure the jitter."""
    model_error: dict[str, Annotated[float, Field(ge=0, allow_inf_nan=False)]] = {}
    """What the model itself gets wrong of a parameter (sd, as a share of it; of a linear one in prior sd), as
    logs with known parameters show. No log averages it away: it is added to the noise's sd."""
    assumed: AssumedSettings = AssumedSettings()
    """How far numbers of the model that are no parameters may be off."""
    geared: list[str] = []
    """Joints with a gear, by names or patterns. What their friction may have besides a constant is then an
    assumed value too: `load_friction`, `stribeck` and `spring`. Joints of direct drives have none."""

    @model_validator(mode="before")
    @classmethod
    def _without_former(cls, given: Any) -> Any:
        """Files and result folders of former versions may set `profile_points`, which is ignored."""
        return {k: v for k, v in given.items() if k != "profile_points"} if isinstance(given, dict) else given


#: Settings of the online estimator that act with one of its methods only.
_ACTS_WITH: dict[str, str] = {
    **dict.fromkeys(("learning_rate", "elites", "sigma", "sigma_floor"), "logrank"),
    **dict.fromkeys(("first_state", "step", "jump", "jump_windows", "jump_sd", "information"), "linearised"),
}


class MheSettings(SettingsGroup):
    """The sampling MHE of `amhe mhe-replay` and `amhe run --mode adaptive`.

    The paper's seven hyper-parameters, and ours. Each default was measured: docs/notes/estimation.md.
    """

    method: Literal["linearised", "logrank"] = "linearised"
    """The update: ours, or the paper's (Algorithm 1, MHE-Estimate)."""
    window: Positive = 0.5
    """Window H [s]."""
    update_period: Positive = 0.2
    """Time between two updates [s], the paper's dt_update. In a replay with a longer window than the system's
    own it is longer in proportion, unless it is set along with the window."""
    samples: Annotated[int, Field(ge=4)] | None = None
    """Rollouts B of one iteration; None: 8 for linearised (which adds one at the mean), 32 for logrank."""
    iterations: Annotated[int, Field(ge=1)] | None = None
    """Iterations L_MHE of one update, at most; None: 3 for linearised, 1 where first states are taken as
    recorded; 4 for logrank."""
    learning_rate: Annotated[float, Field(gt=0, le=1)] = 0.5
    """alpha of logrank: how far an iteration moves the mean and the variance of the samples."""
    prior_weight: dict[str, Annotated[float, Field(ge=0, allow_inf_nan=False)]] = {}
    """Weight w_NAME of a parameter's squared distance from the last estimate, in prior sd, against the
    window's mean squared residual (logrank); in linearised, steps are shorter by it. Default 0."""
    first_state: Literal["estimated", "recorded"] = "estimated"
    """Errors of a window's first state: fitted along by linearised, two rollouts for each of its unknowns; or
    left to `cost.smoothing`, where they are many."""
    elites: Annotated[float, Field(gt=0, le=1)] = 0.3
    """Share of the samples that logrank learns from."""
    sigma: Positive = 0.2
    """Start sd of logrank's samples, as a share of the parameter."""
    sigma_floor: Positive = 0.02
    """logrank stops once every sd is below this share of its parameter (the paper's sigma_floor)."""
    step: Annotated[float, Field(gt=0, le=1)] = 0.15
    """Least sampling sd of linearised, as a share of the parameter: smaller steps measure the jitter of
    contacts."""
    start_sd: Positive = 0.2
    """Floor under the sd of a belief that is loaded for live use, as a share of each value."""
    excitation: Annotated[float, Field(ge=0)] = 0.1
    """Least excitation of a window: how far its samples move the predictions, in noise sd (rms). A window
    below it is skipped, unless it indicates a jump: samples around a light box hardly move the predictions
    while the true box is heavy."""
    jump: Positive = 3.0
    """Innovation that indicates a jump of the parameters: the squared distance between window and belief, as
    the number of sd at which a single normal number is as unlikely."""
    jump_windows: Annotated[int, Field(ge=1)] = 1
    """Number of such windows in a row that are needed for a jump. A single one may come from a contact that
    the model missed."""
    jump_sd: Positive = 0.6
    """Sd that is added to each parameter at a jump, before its window updates the belief, in sd of the
    system's prior."""
    information: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Share of a window's information that linearised counts; less than all where first states are taken as
    recorded: their errors bend a whole window one way, which no residual's noise shows."""
    systematic: dict[str, Annotated[float, Field(allow_inf_nan=False)]] = {}
    """Error of the model itself along one direction of the parameters: sd of each of them, as a share of its
    value (of a linear one, in prior sd); signs give the direction. More windows do not reduce this error. It
    widens the reported intervals and changes no estimate."""
    budget: Positive | None = None
    """Most time that one live update may take [s]; None: the update period."""
    latency: Annotated[float, Field(ge=0)] = 0.1
    """Simulation in lock-step: time from a window's end until its belief is there, for the next plan [s]."""

    @property
    def sample_count(self) -> int:
        """Number of samples B of an iteration."""
        return self.samples or {"linearised": 8, "logrank": 32}[self.method]

    @property
    def iteration_count(self) -> int:
        """Number of iterations L_MHE of an update."""
        own = 3 if self.first_state == "estimated" else 1
        return self.iterations or {"linearised": own, "logrank": 4}[self.method]

    def idle(self, names: Iterable[str]) -> list[str]:
        """Which of these settings have an effect with the other method only."""
        return [name for name in names if _ACTS_WITH.get(name, self.method) != self.method]

    def weights(self, names: Sequence[str]) -> list[float]:
        """Weight of each of these parameters."""
        return [self.prior_weight.get(name, 0.0) for name in names]


class ProbeSettings(SettingsGroup):
    """The design of `amhe probe`."""

    pairs: Annotated[int, Field(ge=0)] = 1
    """Pairs of draws of the belief, in addition to its mean, that the information is averaged over."""
    candidates: Annotated[int, Field(ge=1)] = 12
    """Random motions to choose from, where actuators are driven as they are."""
    speed: Positive | None = None
    """Largest speed of a driven joint [rad/s or m/s]; None: 3.14 of hinges, 0.5 of slides."""
    rate: Annotated[float, Field(ge=10, le=1000)] = 100.0
    """Commands a second, where actuators are driven as they are [Hz]."""


def _several(given: Any) -> Any:
    """'a, b' is two."""
    return [part.strip() for part in given.split(",") if part.strip()] if isinstance(given, str) else given


class LiveSettings(SettingsGroup):
    """Where `amhe watch` and `amhe record` find topics, and what they keep."""

    domain: Annotated[int, Field(ge=0, le=232)] = 0
    """ROS_DOMAIN_ID of the robot."""
    peers: Annotated[list[str], BeforeValidator(_several)] = []
    """Addresses to look for participants on; where there are some, nothing is sent by multicast."""
    interface: str | None = None
    """Address of the one network interface that DDS uses; None: DDS chooses."""
    connect: str = "tcp/localhost:7447"
    """Zenoh's router."""
    foxglove: Annotated[int, Field(ge=0, le=65535)] | None = None
    """Port at which Foxglove sees what `amhe watch` publishes, on this computer; 0: any that is free."""
    remap: Annotated[list[str], BeforeValidator(_several)] = []
    """Rules such as `/joint_states:=/arm/joint_states`; `__ns:=/arm` puts the other topics into /arm."""
    sim_time: bool = False
    """Stamp messages that have no stamp of their own by the topic /clock, as ROS does under use_sim_time."""


class Settings(SettingsGroup):
    """All settings of a system; a robot adds groups of its own by a subclass."""

    logs: LogSettings = LogSettings()
    clips: ClipSettings = ClipSettings()
    cost: CostSettings = CostSettings()
    identify: IdentifySettings = IdentifySettings()
    mhe: MheSettings = MheSettings()
    probe: ProbeSettings = ProbeSettings()
    live: LiveSettings = LiveSettings()
