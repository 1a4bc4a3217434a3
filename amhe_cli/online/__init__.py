"""The sampling moving-horizon estimator: newest window in, newest belief out, again and again."""
