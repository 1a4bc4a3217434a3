"""What `amhe check` expects of a fit, against what `amhe identify` then says, on the problems of honesty.py.

    python benchmarks/expected.py [--seeds 20] [--problems gain,limit] [--jobs 2] [--part 1/3] [--add FILE...]

Each fit is printed as it ends. Of many parts, each run by itself, `--add` takes what their runs have printed.
`--fits` takes fits that a run has printed: their logs are looked at anew, and not fitted again.

Of each parameter's sd, the expected one should be within a factor of 1.5 of the reported one in 90 %, and the
expected verdict right in 85 %. An sd counts on its parameter's own scale, in sd of its prior.
"""

from __future__ import annotations

import argparse
import functools
import hashlib
import json
import logging
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from common import add_parts, in_parts, seeds_of, show
from honesty import KINDS, NAMES, case_of, place

import amhe_cli as amhe
from amhe_cli.estimation.design.expected import expected

#: A factor by which sd may differ.
FACTOR = 1.5
#: Verdicts that claim a value.
CLAIMED = ("identified", "conditional")


def trial(number: int, fits: Mapping[int, dict[str, Any]]) -> dict[str, Any]:
    """Look at one log, and then fit it, unless it is among some fits."""
    logging.disable(logging.WARNING)
    name, kind, seed, made = case_of(number)
    logs = [made.logs] if isinstance(made.logs, amhe.Log) else list(made.logs)
    began = time.process_time()
    hope = {p.name: p for p in expected(made.system, logs, seed=seed).parameters}
    looked = time.process_time() - began
    fit = fits.get(number) or fitted(made.system, logs, seed)
    names, left, said, budgets = fit["names"], fit["left"], fit["verdicts"], fit["budgets"]
    return fit | {
        "problem": name,
        "kind": kind,
        "look": looked,
        "ratios": [(1.0 - hope[p].shrinkage) / each for p, each in zip(names, left, strict=True)],
        "verdicts": [(hope[p].verdict, each) for p, (_, each) in zip(names, said, strict=True)],
        "budgets": [(hope[p].budget, each) for p, (_, each) in zip(names, budgets, strict=True)],
    }


def fitted(system: amhe.System, logs: Sequence[amhe.Log], seed: int) -> dict[str, Any]:
    """What an identification reports; `left`: the sd of each parameter, in sd of its prior."""
    began = time.process_time()
    result = amhe.identify(system, logs, seed=seed, threads=1)
    found = result.parameters.values()
    return {
        "fit": time.process_time() - began,
        "names": list(result.parameters),
        "left": [1.0 - p.shrinkage for p in found],
        "verdicts": [("", p.verdict) for p in found],
        "budgets": [("", p.budget) for p in found],
        "misfit": max(result.found.noise_scale.values(), default=0.0),
    }


def row(label: str, kind: str, trials: Sequence[dict[str, Any]]) -> tuple[str, ...]:
    """One line of the table, over the parameters of some trials."""
    ratios = np.log([ratio for one in trials for ratio in one["ratios"]])
    verdicts = [pair for one in trials for pair in one["verdicts"]]
    same = sum(one == other for one, other in verdicts)
    claims = sum((one in CLAIMED) == (other in CLAIMED) for one, other in verdicts)
    low, middle, high = np.exp(np.quantile(ratios, (0.05, 0.5, 0.95)))
    return (
        label, kind, str(ratios.size), f"{np.mean(np.abs(ratios) < np.log(FACTOR)):.0%}",
        f"{low:.2f} {middle:.2f} {high:.2f}", f"{same / len(verdicts):.0%}",
        f"{claims / len(verdicts):.0%}",
        f"{np.median([one['look'] for one in trials]):.1f} s",
        f"{np.median([one['fit'] for one in trials]):.1f} s",
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=seeds_of, default=range(15), metavar="N or A:B")
    parser.add_argument("--problems", default=",".join(NAMES), help="names, with commas between")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    add_parts(parser)
    parser.add_argument("--fits", type=Path, help="what a run has printed")
    given = parser.parse_args()
    problems = given.problems.split(",")
    numbers = [place(name, kind, seed) for seed in given.seeds for name in problems for kind in KINDS]
    lines = given.fits.read_text(encoding="utf-8").splitlines() if given.fits else ()
    fits = {one["seed"]: one for one in (json.loads(line) for line in lines if line.startswith('{"seed"'))}
    if given.fits and (absent := set(numbers) - fits.keys()):
        parser.error(f"--fits: {given.fits} lacks {len(absent)} of these fits")
    name = f"looks-{hashlib.sha1(given.fits.read_bytes()).hexdigest()[:8]}" if given.fits else "expected"
    done = in_parts(name, functools.partial(trial, fits=fits), numbers, given)
    problems = [name for name in problems if any(t["problem"] == name for t in done)]
    lines = [row(name, "", [t for t in done if t["problem"] == name]) for name in problems]
    lines += [row("all", kind, [t for t in done if t["kind"] == kind]) for kind in KINDS]
    show(
        f"Expected against reported, {len(done)} fits",
        (
            "problem", "", "sd", "within 1.5 (>= 90 %)", "ratio: 5, 50, 95 %", "verdict right (>= 85 %)",
            "claimed or not right", "CPU of the look", "of the fit",
        ),
        [*lines, row("all", "", done)],
    )  # fmt: skip


if __name__ == "__main__":
    main()
