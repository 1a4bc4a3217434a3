"""The sampling moving-horizon estimator."""
