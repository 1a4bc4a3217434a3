"""The paper's own numbers (Adaptive-MHE, tables I and II), for comparison. The only place for them."""

from __future__ import annotations

#: Mode of the paper -> our mode; the paper has no `stale`.
MODES = {"true": "True", "baseline": "Baseline", "adaptive": "Adaptive-MHE"}

#: Table I, T4, 15 seeds: measure -> mode -> mean and sd.
TABLE_1: dict[str, dict[str, tuple[float, float]]] = {
    "success": {"true": (1.0, 0.0), "baseline": (0.1333, 0.352), "adaptive": (0.867, 0.352)},
    "goal_error_m": {"true": (0.045, 0.02), "baseline": (0.58, 0.23), "adaptive": (0.16, 0.24)},
    "cost": {"true": (0.43e5, 0.03e5), "baseline": (0.62e5, 0.04e5), "adaptive": (0.51e5, 0.05e5)},
    "time_s": {"true": (48.1, 0.2), "baseline": (77.4, 0.13), "adaptive": (56.3, 0.04)},
}
TABLE_1_TASK = "t4"

#: Table II: (task, measure) -> mode -> value.
TABLE_2: dict[tuple[str, str], dict[str, float]] = {
    ("t1", "speed_rmse"): {"true": 0.134, "baseline": 0.160, "adaptive": 0.139},
    ("t2", "speed_rmse"): {"true": 0.108, "baseline": 0.119, "adaptive": 0.104},
    ("t3", "speed_rmse"): {"true": 0.093, "baseline": 0.117, "adaptive": 0.092},
    ("t4", "speed_rmse"): {"true": 0.095, "baseline": 0.099, "adaptive": 0.097},
    ("t5", "goal_error_m"): {"true": 0.12, "baseline": 0.42, "adaptive": 0.28},
    ("t5", "speed_rmse"): {"true": 0.051, "baseline": 0.149, "adaptive": 0.052},
}
