"""Make the figures of the pages that explain: `python docs/make_understand_figures.py FOLDER`.

FOLDER keeps the results between runs; those that are missing are made, in some four minutes.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

import amhe_cli as amhe

FIGURES = Path(__file__).with_name("figures")
#: Folder of a result -> what makes it.
RESULTS = {
    "pend": ("example:pendulum",),
    "pend-gain": ("example:pendulum", "--set", "identify.assumed.gain=0.1"),
    "demo": ("example:t1",),
}
#: Colours of the terms of a budget.
TERMS = {
    "noise": "#4c78a8",
    "prior": "#9d9d9d",
    "repeats": "#f58518",
    "parts": "#e45756",
    "assumed": "#b279a2",
    "search": "#bab0ac",
}
#: Radius of the ellipse that holds 90 % of a normal distribution in the plane, in sd.
RADIUS_90 = float(np.sqrt(-2.0 * np.log(0.1)))


def main() -> None:
    """Make the results that are missing, and all figures."""
    folder = Path(sys.argv[1])
    for name, arguments in RESULTS.items():
        if not (folder / name).exists():
            command = [sys.executable, "-m", "amhe_cli", "identify", *arguments, "-o", str(folder / name)]
            subprocess.run(command, check=True)
    plt.rcParams |= {"svg.hashsalt": "amhe", "font.size": 10, "axes.spines.top": False}
    plt.rcParams |= {"axes.spines.right": False, "savefig.facecolor": "white"}
    budget(record(folder / "pend"))
    assumed({"gain exact": record(folder / "pend"), "gain known to 10 %": record(folder / "pend-gain")})
    together(amhe.Belief.load(folder / "demo" / "belief.yaml"))


def record(folder: Path) -> dict[str, Any]:
    """The parameters of a result, by name."""
    return {p["name"]: p for p in json.loads((folder / "result.json").read_text())["parameters"]}


def budget(found: dict[str, Any]) -> None:
    """Bars of each parameter's variance by term."""
    figure, axes = plt.subplots(figsize=(7.0, 2.2))
    left = np.zeros(len(found))
    for term, colour in TERMS.items():
        shares = np.array([p["budget"].get(term, 0.0) for p in found.values()])
        if shares.max() > 0.005:
            axes.barh(list(found), 100.0 * shares, left=100.0 * left, color=colour, label=term)
        left += shares
    axes.invert_yaxis()
    axes.set_xlabel("share of the variance [%]")
    axes.legend(ncols=6, loc="lower left", bbox_to_anchor=(0.0, 1.0), frameon=False)
    save(figure, "budget")


def assumed(results: dict[str, dict[str, Any]]) -> None:
    """The interval of the load under two assumptions."""
    figure, axes = plt.subplots(figsize=(7.0, 1.7))
    for name, found in results.items():
        p = found["load_mass"]
        axes.plot([p["lower"], p["upper"]], [name, name], lw=7, solid_capstyle="butt", color="#b279a2")
        axes.plot(p["estimate"], name, "k|", ms=14)
        axes.annotate(p["verdict"], (p["upper"], name), (6, -3), textcoords="offset points")
    axes.axvline(0.55, color="0.4", lw=1, ls="--")
    axes.annotate("truth", (0.55, 1.55), ha="center", annotation_clip=False, color="0.4")
    axes.set(xlabel="load_mass [kg], 90 % interval", ylim=(-0.6, 1.6), xlim=(0.45, 0.68))
    save(figure, "assumed")


def together(belief: amhe.Belief) -> None:
    """The ellipse of mass and friction, and the line along which their product is constant."""
    rows = [belief.names.index(name) for name in ("box_mass", "floor_friction")]
    at, covariance = np.log(belief.estimate[rows]), belief.covariance[np.ix_(rows, rows)]
    turn = np.linspace(0.0, 2.0 * np.pi, 200)
    values, axes_of = np.linalg.eigh(covariance)
    edge = at + RADIUS_90 * (np.c_[np.cos(turn), np.sin(turn)] * np.sqrt(values)) @ axes_of.T
    figure, axes = plt.subplots(figsize=(5.0, 3.4))
    axes.fill(*np.exp(edge).T, color="#4c78a8", alpha=0.5, label="90 % of what is possible")
    exponent = -axes_of[1, 1] / axes_of[0, 1]
    mass = np.linspace(3.0, 5.4, 50)
    constant = np.exp(at[1]) * (np.exp(at[0]) / mass) ** exponent
    axes.plot(mass, constant, "k--", lw=1, label=f"mu · m^{exponent:.1f} constant")
    axes.plot(4.0, 0.6, "kx", label="truth")
    axes.set(xlabel="box_mass [kg]", ylabel="floor_friction", xlim=(3.0, 5.4), ylim=(0.48, 0.72))
    axes.legend(frameon=False, loc="upper right")
    save(figure, "together")


def save(figure: Any, name: str) -> None:
    """Write one figure."""
    figure.savefig(FIGURES / f"{name}.svg", bbox_inches="tight", metadata={"Date": None})


if __name__ == "__main__":
    main()
