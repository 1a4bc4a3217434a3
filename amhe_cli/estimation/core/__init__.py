"""Core of offline and online estimation and of the design of experiments: linearise, eliminate, step."""
