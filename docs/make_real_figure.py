"""Make the picture of docs/real.md: `python docs/make_real_figure.py DOUBLE_PENDULUM SO101`.

Each argument is a folder with the log that was held out and, as `found/`, the result of the page's command.
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import amhe_cli as amhe
from amhe_cli.core.log import Window
from amhe_cli.engine.open import open_engine
from amhe_cli.matching.cost import MatchingCost

ROOT = Path(__file__).parents[1]
#: System, held-out log, start and length [s], joint, and its column.
SHOWN = (
    ("double_pendulum", "trajectory_143524.csv", 1.0, 4.0, "double pendulum, elbow", 1),
    ("so101", "figure_eight", 5.0, 20.0, "SO-101, shoulder's lift", 1),
)


def main() -> None:
    """Write docs/figures/real.png: measured angles, and predictions from the recorded first state."""
    figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
    for place, (folder, (name, log, start, seconds, title, joint)) in zip(
        axes, zip(sys.argv[1:], SHOWN, strict=True), strict=True
    ):
        system = amhe.System.load(ROOT / "examples" / "systems" / name)
        belief = amhe.Belief.load(Path(folder) / "found" / "belief.yaml", system)
        first, steps = (round(time / system.dt) for time in (start, seconds))
        window = Window(amhe.read_log(Path(folder) / log, system), first, steps)
        cost = MatchingCost(system, [window], open_engine(system), system.settings.cost)
        observed = cost.clips.observed[0]
        z = system.space.z_of(np.array([system.space.nominal, belief.estimate]))
        before, after = np.degrees(cost.predict(z).values[0][:, 0, :, joint])
        time = (observed.rows[0] + 1) * system.dt
        place.plot(time, np.degrees(observed.measured[0, :, joint]), "k", lw=2.5, label="measured")
        place.plot(time, before, "C1", lw=1.5, label="predicted, before identification")
        place.plot(time, after, "C0", lw=1.5, label="predicted, identified")
        place.set(title=title, xlabel="time [s]", ylabel="angle [°]")
        place.grid(alpha=0.3)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False)
    path = ROOT / "docs" / "figures" / "real.png"
    figure.savefig(path, dpi=110)
    print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
