"""A hobby servo swings weighed loads: how heavy are they, by what `amhe init --drive` writes?

    python benchmarks/weigh.py [--seeds 10] [--jobs 2]

The plant is a Feetech STS3215 at 12 V that is *not* the model which `init` writes: friction of the model M6
of arXiv 2410.08650, larger at rest and uneven over a turn, a least PWM, a lag of the firmware, a supply that
sags, an encoder of 4096 counts with a zero of its own. It is integrated here, by nothing of the package.
Each log of 6 s is weighed twice, as a user would do with the commands:

    alone        `amhe init bench.xml LOG --drive hinge=feetech:sts3215 --volts 12 --gain-p 16`, then
                 `amhe identify LOG`
    calibrated   four logs of two weighed loads give a belief about the servo; with it the others are weighed

At least 60 % of the masses must be identified or conditional, 90 % of these must hold, and their median error
must be 5 %. Beside them stand plain least squares of the torques that the servo's data sheet promises, and
`mujoco.sysid` with the same parameters (where it is installed).
"""

from __future__ import annotations

import argparse
import logging
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from common import over_seeds, seeds_of, show

import amhe_cli as amhe
from amhe_cli.core.arrays import FloatArray
from amhe_cli.init.drive_library import drive as library_drive
from amhe_cli.init.folder import init_system
from amhe_cli.init.from_library import Chosen

LENGTH, ROD, GRAVITY = 0.12, 0.04, 9.81
#: Weighed loads [kg]; the model says 1 kg. The first two of them calibrate.
LOADS = (0.66, 1.27, 0.58, 0.79, 0.92, 1.06, 1.18, 1.40)
VOLTS, GAIN = 12.0, 16
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


def servo_of(rng: np.random.Generator) -> dict[str, float]:
    """What a servo of the type is really like."""
    full = 12.0 * 0.454 * 0.97 * np.exp(rng.normal(0.0, 0.2))  # torque at full duty and 12 V
    return {
        "full": full,
        "counts": 16 * 0.166 / 0.97 * np.exp(rng.normal(0.0, 0.05)),  # share of full duty by radian
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
    servo: dict[str, float], load: float, motion: str, rng: np.random.Generator
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
        duty = float(np.clip(servo["counts"] * error, -1.0, 1.0))
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


def prepared(folder: Path, log: Path, gain: float = GAIN) -> amhe.System:
    """The system that `amhe init --drive` writes for a log."""
    chosen = Chosen({"hinge": "feetech:sts3215"}, VOLTS, gain)
    init_system(folder / "bench.xml", [log], folder / f"system_{log.stem}", force=True, drives=chosen)
    return amhe.System.load(folder / f"system_{log.stem}", warn=False)


def weighed(system: amhe.System, log: Path, belief: amhe.Belief | None = None) -> dict[str, Any]:
    """What `amhe identify` says of the load of a log."""
    began = time.process_time()
    result = amhe.identify(system, amhe.read_log(log, system), prior=belief, threads=1)
    mass = result.parameters["load_mass"]
    return {
        "log": log.stem,
        "estimate": mass.estimate,
        "lower": mass.lower,
        "upper": mass.upper,
        "verdict": mass.verdict,
        "reasons": [reason.text for reason in mass.reasons],
        "seconds": time.process_time() - began,
    }


def calibrated(system: amhe.System, logs: list[tuple[Path, float]]) -> amhe.Belief:
    """What is believed of the servo by logs of known loads."""
    read = [replace(amhe.read_log(path, system), known={"load_mass": load}) for path, load in logs]
    return amhe.identify(system, read, threads=1).belief


def least_squares(log: Path) -> float:
    """The load by plain least squares of the data sheet's torque: weight, inertia and constant friction."""
    time_, angle, target = np.loadtxt(log, delimiter=",", skiprows=1, unpack=True)[:3]
    window = np.arange(-15, 16) * float(np.median(np.diff(time_)))
    _, by_speed, by_change, _ = np.linalg.pinv(np.vander(window, 4, increasing=True))  # a cubic's
    speed, change = (np.convolve(angle, one[::-1], mode="same") for one in (by_speed, 2.0 * by_change))
    drive = library_drive("feetech:sts3215", VOLTS).servo(VOLTS, GAIN)
    torque = np.clip(drive.kp * (target - angle), -drive.limit, drive.limit) - drive.kv * speed
    columns = np.column_stack([np.sin(angle), change, np.sign(speed), speed])
    moving = np.abs(speed) > 0.1
    moving[:15] = moving[-15:] = False
    weight = np.linalg.lstsq(columns[moving], torque[moving], rcond=None)[0][0]
    return float(weight / GRAVITY / LENGTH - ROD / 2.0)


def trial(seed: int) -> dict[str, Any]:
    """One servo: each log of eight loads alone, and calibrated by two of them."""
    logging.disable(logging.WARNING)
    rng = np.random.default_rng([seed, 3215])
    servo, found = servo_of(rng), []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "bench.xml").write_text(MODEL)
        logs = {
            (load, motion): written(folder, f"{motion}_{1000 * load:.0f}", swing(servo, load, motion, rng))
            for load in LOADS
            for motion in MOTIONS
        }
        moving = [key for key in logs if key[1] != "lift_and_drop"]
        system = prepared(folder, logs[moving[0]])
        belief = calibrated(system, [(logs[key], key[0]) for key in moving if key[0] in LOADS[:2]][:4])
        for load, motion in sorted(logs):
            path, about = logs[load, motion], {"truth": load, "motion": motion}
            if load in LOADS[2:]:
                if motion != "lift_and_drop":
                    found.append(about | {"how": "calibrated"} | weighed(system, path, belief))
                alone = weighed(prepared(folder, path), path)
                found.append(about | {"how": "alone", "least_squares": least_squares(path)} | alone)
    return {
        "servo": servo,
        "belief": dict(zip(belief.names, belief.estimate.tolist(), strict=True)),
        "found": found,
    }


def row(label: str, found: list[dict[str, Any]]) -> tuple[str, ...]:
    """One line of the table."""
    claimed = [one for one in found if one["verdict"] in ("identified", "conditional")]
    held = [one["lower"] <= one["truth"] <= one["upper"] for one in found]
    errors = [100.0 * (one["estimate"] / one["truth"] - 1.0) for one in found]
    plain = [100.0 * (one["least_squares"] / one["truth"] - 1.0) for one in found if "least_squares" in one]
    wide = [one["upper"] / one["lower"] for one in found]
    seconds = sorted(one["seconds"] for one in found)
    return (
        label,
        f"{len(claimed)} of {len(found)}, {len(claimed) / len(found):.0%}",
        f"{sum(one['lower'] <= one['truth'] <= one['upper'] for one in claimed)} of {len(claimed)}",
        f"{np.mean(held):.0%}",
        f"{np.median(np.abs(errors)):.1f} %",
        f"{np.median(errors):+.1f} %",
        f"{np.median(wide):.2f}",
        f"{np.median(np.abs(plain)):.0f} %" if plain else "",
        ", ".join(f"{n} {verdict}" for verdict, n in Counter(one["verdict"] for one in found).most_common(3)),
        f"{seconds[len(seconds) // 2]:.1f} s",
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=seeds_of, default=range(10), metavar="N or A:B")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    given = parser.parse_args()
    done = over_seeds("weigh", trial, given.seeds, given.jobs)
    found = [one for trial_ in done for one in trial_["found"]]
    ways = {how: [one for one in found if one["how"] == how] for how in ("alone", "calibrated")}
    rows = [row(how, some) for how, some in ways.items()]
    for how, some in ways.items():
        motions = {one["motion"] for one in some}
        rows += [row(f"{how}, {m}", [one for one in some if one["motion"] == m]) for m in sorted(motions)]
    columns = ("weighed", "claimed", "of these hold", "hold", "median error", "bias", "upper/lower")
    title = f"{len(done)} servos of one type, weighed loads"
    show(title, (*columns, "least squares errs", "verdicts", "CPU"), rows)


if __name__ == "__main__":
    main()
