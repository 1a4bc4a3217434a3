"""Floor 4: the loop of target, estimator and controller, what it logs, and how well it did."""
