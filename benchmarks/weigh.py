"""A hobby servo swings weighed loads: how heavy are they, by what `amhe init --drive` writes?

    python benchmarks/weigh.py [--seeds 10] [--jobs 2]
    python benchmarks/weigh.py --real [--jobs 2]
    python benchmarks/weigh.py --wrong [--part 1/5] [--jobs 2]

The plant is a Feetech STS3215 at 12 V that is *not* the model which `init` writes: friction of the model M6
of arXiv 2410.08650, larger at rest and uneven over a turn, a least PWM, a lag of the firmware, a supply that
sags, an encoder of 4096 counts with a zero of its own. It is integrated here, by nothing of the package.
Each log of 6 s is weighed twice, as a user would do with the commands:

    alone        `amhe init bench.xml LOG --drive hinge=feetech:sts3215 --volts 12 --gain-p GAIN`, then
                 `amhe identify LOG`
    calibrated   four logs of two weighed loads, at the lowest and the highest gain, give a belief about the
                 servo; with it the others are weighed, at any gain

At least 60 % of the masses must be identified or conditional, 90 % of these must hold, and their median error
must be 5 %. Beside them stand plain least squares of the torques that the servo's data sheet promises, and
`mujoco.sysid` (where it is installed) of the same log, with mass, damping, friction and armature free.

`--real` does so with logs of a Dynamixel XL330: each alone; with the mass known, for the torque per volt; all
whose torque is on together; and by two or four of them the others. `--wrong` takes gain and limit of that
servo as exact, and has one of them wrong: no mass may be called identified.
Errors are medians; beside them stand the mean over the truth, and the scatter about that mean.
"""

from __future__ import annotations

import argparse
import logging
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml
from against_sysid import Case, with_sysid
from common import DATA, PROJECT, add_parts, in_parts, seeds_of, show
from mujoco import sysid

import amhe_cli as amhe
from amhe_cli.core.arrays import FloatArray
from amhe_cli.init.drive_library import Chosen
from amhe_cli.init.drive_library import drive as library_drive
from amhe_cli.init.folder import init_system

LENGTH, ROD, GRAVITY = 0.12, 0.04, 9.81
#: Weighed loads [kg]; the model says 1 kg. The first two of them calibrate.
LOADS = (0.66, 1.27, 0.58, 0.79, 0.92, 1.06, 1.18, 1.40)
VOLTS, GAINS, RATIO = 12.0, (8, 16, 32), "hinge_gain_ratio"
#: Time step of the plant [s], and of the log.
STEP, PERIOD = 5e-4, 0.0067
MODEL = f"""<mujoco model="bench"><option timestep="0.005" integrator="implicitfast"/>
  <worldbody><body name="rod"><joint name="hinge" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 -{LENGTH}" size="0.008" mass="{ROD}" contype="0" conaffinity="0"/>
    <body name="load" pos="0 0 -{LENGTH}"><geom size="0.03" mass="1" contype="0" conaffinity="0"/></body>
  </body></worldbody>
  <actuator><position name="servo" joint="hinge" kp="15"/></actuator></mujoco>"""

#: Time [s] -> target [rad]; of the last the torque is off from 2 s on.
MOTIONS: dict[str, Callable[[float], float]] = {
    "sin_time_square": lambda t: np.sin(t * t),
    "up_and_down": lambda t: np.pi / 4.0 * (1.0 - np.cos(np.pi * t / 3.0)),
    "sin_sin": lambda t: 0.9 * np.sin(t) + 0.5 * np.sin(5.0 * t) * np.sin(2.0 * t),
    "lift_and_drop": lambda t: -np.pi / 4.0 * (1.0 - np.cos(np.pi * min(t, 2.0) / 2.0)),
}
OFF = 2.0
#: What the model of the XL330 has wrong: factors on gain and limit.
WRONG = {
    "gain -30 %": (0.7, 1.0),
    "gain +30 %": (1.3, 1.0),
    "limit -40 %": (1.0, 0.6),
    "limit +40 %": (1.0, 1.4),
}
#: Logs of the XL330 that calibrate, at the lowest and the highest gain; the others are weighed.
CALIBRATE = {
    "all at once": (),
    "by two": ("kp100_sin_sin", "kp800_up_and_down"),
} | {
    f"by four, {a} and {b}": tuple(f"kp{gain}_{motion}" for gain in (100, 800) for motion in (a, b))
    for a, b in combinations(("sin_time_square", "up_and_down", "sin_sin"), 2)
}


def servo_of(rng: np.random.Generator) -> dict[str, float]:
    """What a servo of the type is really like."""
    full = 12.0 * 0.454 * 0.97 * np.exp(rng.normal(0.0, 0.2))  # torque at full duty and 12 V
    return {
        "full": full,
        "counts": 0.166 / 0.97 * np.exp(rng.normal(0.0, 0.05)),  # share of full duty by radian and count
        "back_emf": full / 4.71 * np.exp(rng.normal(0.0, 0.1)),
        "armature": 0.024 * np.exp(rng.normal(0.0, 0.3)),
        "viscous": 0.05 * np.exp(rng.normal(0.0, 0.3)),
        "dry": 0.05 * np.exp(rng.normal(0.0, 0.3)),
        "k_m": rng.normal(0.10, 0.03),
        "k_e": rng.normal(0.20, 0.05),
        "quadratic": rng.uniform(0.0, 0.03),
        "stribeck": 0.05 * np.exp(rng.normal(0.0, 0.3)),
        "k_s": rng.normal(0.05, 0.02),
        "v_s": 0.2 * np.exp(rng.normal(0.0, 0.3)),
        "uneven": rng.uniform(0.0, 0.1),
        "punch": 0.025 * np.exp(rng.normal(0.0, 0.2)),
        "band": 0.0015,
        "lag": rng.uniform(0.008, 0.018),
        "late": rng.uniform(0.0, 0.008),
        "sag": rng.uniform(0.05, 0.2),
        "zero": rng.normal(0.0, 0.02),
    }


def swing(
    servo: dict[str, float], load: float, motion: str, gain: int, rng: np.random.Generator
) -> dict[str, FloatArray]:
    """What a bench records of 6 s: times, angles, targets, and whether the torque is on."""
    target, inertia = MOTIONS[motion], servo["armature"] + LENGTH**2 * (load + ROD / 3.0) + 0.4 * load * 9e-4
    weight = GRAVITY * LENGTH * (load + ROD / 2.0)
    angle, speed, seen, count = 0.0, 0.0, 0.0, 2.0 * np.pi / 4096
    times = np.arange(0.0, 6.0, STEP)
    angles = np.empty(times.size)
    for k, t in enumerate(times):
        angles[k] = angle
        on = not (motion == "lift_and_drop" and t >= OFF)
        read = count * round((angle + servo["zero"]) / count)
        seen += STEP / servo["lag"] * (target(max(0.0, t - servo["late"])) - seen)
        error = seen - read
        duty = float(np.clip(gain * servo["counts"] * error, -1.0, 1.0))
        if abs(error) < servo["band"]:
            duty = 0.0
        elif abs(duty) < servo["punch"]:
            duty = float(np.copysign(servo["punch"], error))
        motor = (
            (servo["full"] * duty - servo["back_emf"] * speed) / (1.0 + servo["sag"] * duty**2) if on else 0.0
        )
        outside = -weight * np.sin(angle)
        holds = servo["dry"] + abs(servo["k_e"] * outside - servo["k_m"] * motor)
        holds += servo["quadratic"] * max(-motor * outside, 0.0)
        slow = np.exp(-((speed / servo["v_s"]) ** 2))
        holds += slow * (servo["stribeck"] + servo["k_s"] * abs(outside - motor))
        holds *= 1.0 + servo["uneven"] * np.sin(18.0 * angle)
        free = speed + STEP / inertia * (motor + outside - servo["viscous"] * speed)
        speed = float(np.sign(free) * max(abs(free) - STEP / inertia * holds, 0.0))
        angle += STEP * speed
    at = np.arange(0.0, 5.99, PERIOD) + rng.uniform(0.0, 5e-4, int(np.ceil(5.99 / PERIOD)))
    rows = np.minimum((at / STEP).astype(int), times.size - 1)
    read = count * np.round((angles[rows] + servo["zero"]) / count)
    if rng.random() < 0.15:
        read[rng.integers(50, read.size - 50)] = np.pi  # a spike, as its bus makes them
    columns = {"time": at, "pos_hinge": read, "cmd_pos_hinge": np.array([target(t) for t in at])}
    return columns | ({"torque_enable": (at < OFF).astype(float)} if motion == "lift_and_drop" else {})


def written(folder: Path, name: str, columns: dict[str, FloatArray]) -> Path:
    """A log as a CSV."""
    path, table = folder / f"{name}.csv", np.column_stack(list(columns.values()))
    np.savetxt(path, table, delimiter=",", header=",".join(columns), comments="", fmt="%.6f")
    return path


@dataclass(frozen=True)
class Bench:
    """What a user tells `amhe init`: model, joint, drive of the library, and supply [V]."""

    model: Path
    joint: str
    drive: str
    volts: float

    def system(self, log: Path, gain: float) -> amhe.System:
        """The system that `amhe init --drive` writes for a log."""
        folder = self.model.parent / f"system_{log.stem}"
        chosen = Chosen({self.joint: self.drive}, self.volts, gain)
        init_system(self.model, [log], folder, force=True, drives=chosen)
        return amhe.System.load(folder, warn=False)

    def least_squares(self, system: amhe.System, log: Path, gain: float) -> float:
        """The load by plain least squares of the data sheet's torque: weight, inertia, constant friction."""
        read = amhe.read_log(log, system)
        angle, target = (read[f"{name}.position"].values[:, 0] for name in ("joints", "command"))
        window = np.arange(-15, 16) * read.dt
        _, by_speed, by_change, _ = np.linalg.pinv(np.vander(window, 4, increasing=True))  # a cubic's
        speed, change = (np.convolve(angle, one[::-1], mode="same") for one in (by_speed, 2.0 * by_change))
        servo = library_drive(self.drive, self.volts).servo(self.volts, gain)
        assert servo.kp is not None and servo.limit is not None and servo.kv is not None
        torque = np.clip(servo.kp * (target - angle), -servo.limit, servo.limit) - servo.kv * speed
        moving = np.abs(speed) > 0.1
        moving[:15] = moving[-15:] = False
        columns = np.column_stack([self._weight_of_a_kilogram(system, angle), change, np.sign(speed), speed])
        return float(np.linalg.lstsq(columns[moving], torque[moving], rcond=None)[0][0])

    def _weight_of_a_kilogram(self, system: amhe.System, angle: FloatArray) -> FloatArray:
        """Gravity's torque by each kilogram of the load; other links are left out."""
        model, data, forces = system.model, mujoco.MjData(system.model), np.empty(angle.size)
        for i, value in enumerate(angle):
            data.qpos[0] = value
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_rne(model, data, 0, data.qfrc_bias)
            forces[i] = data.qfrc_bias[0]
        return forces / model.body("load").mass[0]

    def by_sysid(self, system: amhe.System, log: Path) -> dict[str, float]:
        """The load by `mujoco.sysid`: the servo as MuJoCo has it, constant friction; {}: there is none."""
        if not hasattr(sysid, "TimeSeries"):
            return {}  # it is not installed
        own: dict[str, Any] = {
            name: {"nominal": nominal, "prior_sd": 1.0, "targets": [{"joint": self.joint, "set": name}]}
            for name, nominal in (("damping", 0.05), ("armature", 0.01), ("friction_loss", 0.05))
        }
        own["load_mass"] = {"prior_sd": 0.7, "targets": [{"body": "load", "set": "mass"}]}
        description = yaml.safe_load(system.text)
        description["signals"]["joints"]["noise"]["velocity"] = 5.0  # of next to no weight
        spec = mujoco.MjSpec.from_file(str(system.folder / description["model"]))
        servo = spec.actuators[0]
        kv = float(spec.numerics[0].data[3])  # the back-EMF, which `init` keeps beside the firmware
        servo.biasprm = [0.0, servo.biasprm[1], -kv, *[0.0] * 7]
        for numeric in list(spec.numerics):
            spec.delete(numeric)
        plain = amhe.System.from_model(
            spec, parameters=own, signals=description["signals"], name="plain", warn=False
        )
        read = amhe.read_log(log, plain)
        path = with_sysid(Case(plain, [read], [read]), whitened=True, step=None)
        return {"sysid": plain.space.named(plain.space.theta_of(path.z[-1]))["load_mass"]}


#: A log, and what is known of it.
Known = tuple[Path, dict[str, float]]


def weighed(
    system: amhe.System, logs: Sequence[Known], belief: amhe.Belief | None = None, name: str = "load_mass"
) -> dict[str, Any]:
    """What `amhe identify` says of the load of some logs, or of another parameter that ends in `name`."""
    began, label = time.process_time(), logs[0][0].stem if len(logs) == 1 else f"{len(logs)} logs"
    read = [replace(amhe.read_log(path, system), known=known) for path, known in logs]
    result = amhe.identify(system, read, prior=belief, threads=1)
    found = next(one for full, one in result.parameters.items() if full.endswith(name))
    span = f"{found.estimate:.3f} ({found.lower:.3f} to {found.upper:.3f})"
    print(f"{label}, {name}: {span} {found.verdict}", flush=True)
    return {
        "log": label,
        "estimate": found.estimate,
        "lower": found.lower,
        "upper": found.upper,
        "verdict": found.verdict,
        "reasons": [reason.text for reason in found.reasons],
        "seconds": time.process_time() - began,
    }


def calibrated(system: amhe.System, logs: Sequence[Known]) -> amhe.Belief:
    """What is believed of the servo by logs of known loads."""
    read = [replace(amhe.read_log(path, system), known=known) for path, known in logs]
    return amhe.identify(system, read, threads=1).belief


def trial(seed: int) -> dict[str, Any]:
    """One servo: moving logs of six loads by the belief of four others, and one log of each load alone."""
    logging.disable(logging.WARNING)
    rng = np.random.default_rng([seed, 3215])
    servo, found = servo_of(rng), []
    with tempfile.TemporaryDirectory() as name:
        bench = Bench(Path(name) / "bench.xml", "hinge", "feetech:sts3215", VOLTS)
        bench.model.write_text(MODEL)

        def log(load: float, motion: str, gain: int) -> Path:
            label = f"{motion}_{1000 * load:.0f}_{gain}"
            return written(bench.model.parent, label, swing(servo, load, motion, gain, rng))

        moving = [motion for motion in MOTIONS if motion != "lift_and_drop"]
        two = [
            (load, motion, gain)
            for load, gain in zip(LOADS[:2], GAINS[::2], strict=True)
            for motion in moving[:2]
        ]
        paths = {key: log(*key) for key in two}
        system = bench.system(paths[two[0]], GAINS[0])
        belief = calibrated(
            system, [(paths[key], {"load_mass": key[0], RATIO: key[2] / GAINS[0]}) for key in two]
        )
        for i, load in enumerate(LOADS[2:]):
            for j, motion in enumerate(moving):
                gain = GAINS[(i + j + seed) % len(GAINS)]
                about = {"how": "calibrated", "truth": load, "motion": motion, "gain": gain}
                one = log(load, motion, gain), {RATIO: gain / GAINS[0]}
                found.append(about | weighed(system, [one], belief))
            motion, gain = list(MOTIONS)[(i + seed) % len(MOTIONS)], GAINS[i % len(GAINS)]
            path, about = (
                log(load, motion, gain),
                {"how": "alone", "truth": load, "motion": motion, "gain": gain},
            )
            alone = bench.system(path, gain)
            about |= {"least_squares": bench.least_squares(alone, path, gain)} | bench.by_sysid(alone, path)
            found.append(about | weighed(alone, [(path, {})]))
    estimates = dict(zip(belief.names, belief.estimate.tolist(), strict=True))
    return {"servo": servo, "belief": estimates, "found": found}


def xl330_bench(folder: str) -> Bench:
    """That of the XL330, whose model says 0.4 kg."""
    bench = Bench(Path(folder) / "bench.xml", "pendulum", "dynamixel:xl330-m288", 7.4)
    text = (PROJECT / "examples" / "systems" / "xl330" / "model.xml").read_text()
    bench.model.write_text(text.replace('mass="0.49"', 'mass="0.4"'))
    return bench


def xl330_log(number: int) -> tuple[Path, float, str]:
    """One of its sixteen logs, the gain of its firmware, and the motion."""
    path = sorted((DATA / "xl330").glob("*.mcap"))[number]
    gain, _, motion = path.stem.removeprefix("kp").partition("_")
    return path, float(gain), motion


def real(number: int) -> dict[str, Any]:
    """One log of the XL330 (docs/real.md), or one way to calibrate by some of them."""
    logging.disable(logging.WARNING)
    with tempfile.TemporaryDirectory() as name:
        bench = xl330_bench(name)
        return {"found": alone(bench, number) if number < 16 else together(bench, number - 16)}


def alone(bench: Bench, number: int) -> list[dict[str, Any]]:
    """The load by one log, and with the load known its torque per volt over the data sheet's."""
    path, gain, motion = xl330_log(number)
    system, drops = bench.system(path, gain), motion == "lift_and_drop"
    about = {"truth": 0.49, "motion": motion, "how": "the torque off, alone" if drops else "alone"}
    if drops:
        return [about | weighed(system, [(path, {})])]
    about |= {"least_squares": bench.least_squares(system, path, gain)} | bench.by_sysid(system, path)
    per_volt = weighed(system, [(path, {"load_mass": 0.49})], name="torque_scale")
    return [
        about | weighed(system, [(path, {})]),
        {"how": "torque per volt", "truth": 1.0, "motion": motion} | per_volt,
    ]


def together(bench: Bench, way: int) -> list[dict[str, Any]]:
    """The loads of the logs with the torque on by those that calibrate, or one load of all of them."""
    how, stems = list(CALIBRATE.items())[way]
    on = [log for log in map(xl330_log, range(16)) if log[2] != "lift_and_drop"]
    on.sort(key=lambda log: log[0].stem not in stems)  # those that calibrate first, then by gain
    ratios = {path: {"pendulum_gain_ratio": gain / on[0][1]} for path, gain, _ in on}
    system, about = bench.system(*on[0][:2]), {"how": how, "truth": 0.49}
    if not stems:
        return [about | {"motion": "all"} | weighed(system, list(ratios.items()))]
    known = [(path, {"load_mass": 0.49} | ratios[path]) for path, _, _ in on[: len(stems)]]
    belief = calibrated(system, known)
    return [
        about | {"motion": motion} | weighed(system, [(path, ratios[path])], belief)
        for path, _, motion in on[len(stems) :]
    ]


def wrong(number: int) -> dict[str, Any]:
    """One log of the XL330, whose servo the model has wrong in one way and takes as exact."""
    logging.disable(logging.WARNING)
    way, at = divmod(number, 16)
    (path, gain, motion), (how, (factor, limit)) = xl330_log(at), list(WRONG.items())[way]
    with tempfile.TemporaryDirectory() as name:
        system = xl330_bench(name).system(path, gain)
        description = yaml.safe_load(system.text)
        exact = ("gain", "torque_scale", "gain_ratio")
        parameters = {n: p for n, p in description["parameters"].items() if not n.endswith(exact)}
        spec = mujoco.MjSpec.from_file(str(system.folder / description["model"]))
        servo = spec.actuators[0]
        servo.gainprm = factor * np.array(servo.gainprm)
        servo.biasprm = [0.0, factor * servo.biasprm[1], *servo.biasprm[2:]]
        servo.forcerange = limit * np.array(servo.forcerange)
        other = amhe.System.from_model(
            spec,
            parameters=parameters,
            signals=description["signals"],
            settings=description["settings"],
            name="wrong",
            warn=False,
        )
        return {"found": [{"how": how, "truth": 0.49, "motion": motion} | weighed(other, [(path, {})])]}


def row(label: str, found: list[dict[str, Any]]) -> tuple[str, ...]:
    """One line of the table."""
    claimed = [one for one in found if one["verdict"] in ("identified", "conditional")]
    held = [one["lower"] <= one["truth"] <= one["upper"] for one in found]
    ratios, *plain = (
        np.array([one[way] / one["truth"] for one in found if way in one])
        for way in ("estimate", "least_squares", "sysid")
    )
    wide = [one["upper"] / one["lower"] for one in found]
    seconds = sorted(one["seconds"] for one in found)
    return (
        label,
        f"{len(claimed)} of {len(found)}, {len(claimed) / len(found):.0%}",
        f"{sum(one['lower'] <= one['truth'] <= one['upper'] for one in claimed)} of {len(claimed)}",
        f"{sum(held)} of {len(held)}",
        f"{np.median(wide):.2f}",
        *(_errors(some) for some in (ratios, *plain)),
        ", ".join(f"{n} {verdict}" for verdict, n in Counter(one["verdict"] for one in found).most_common(4)),
        f"{seconds[len(seconds) // 2]:.1f} s",
    )


def _errors(ratios: FloatArray) -> str:
    """Of estimates over truths (n,): the median error, the mean, and the scatter about it."""
    if ratios.size < 2:
        return "".join(f"{100.0 * abs(one - 1.0):.1f} %; {one:.3f}" for one in ratios)
    scatter = ratios.std(ddof=1) / ratios.mean()
    return f"{100.0 * np.median(abs(ratios - 1.0)):.1f} %; {ratios.mean():.3f}, {100.0 * scatter:.1f} %"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=seeds_of, default=range(10), metavar="N or A:B")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--real", action="store_true", help="the logs of the XL330, in place of a simulation")
    parser.add_argument("--wrong", action="store_true", help="these logs, by a servo that is wrong")
    add_parts(parser)
    given = parser.parse_args()
    title = "an XL330 under 0.49 kg"
    if given.wrong:
        done = in_parts("weigh-wrong", wrong, range(16 * len(WRONG)), given)
    elif given.real:
        done = in_parts("weigh-xl330", real, range(16 + len(CALIBRATE)), given)
    else:
        done = in_parts("weigh", trial, given.seeds, given)
        title = f"{len(done)} servos of one type, weighed loads"
    found = [one for trial_ in done for one in trial_["found"]]
    ways = {
        how: [one for one in found if one["how"] == how] for how in dict.fromkeys(o["how"] for o in found)
    }
    rows = [row(how, some) for how, some in ways.items()]
    if not (given.wrong or given.real):
        rows += [
            row(f"{how}, {motion}", [one for one in some if one["motion"] == motion])
            for how, some in ways.items()
            for motion in sorted({one["motion"] for one in some})
        ]
    columns = ("weighed", "claimed", "of these hold", "hold", "upper/lower", "error; mean, scatter")
    show(title, (*columns, "least squares", "sysid", "verdicts", "CPU"), rows)


if __name__ == "__main__":
    main()
