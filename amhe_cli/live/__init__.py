"""The loop of target, estimator and controller, and what it records."""
