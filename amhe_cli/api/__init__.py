"""The calls of a script or a notebook: `identify`, `Estimator`, `probe` and `run`, on objects in memory."""
