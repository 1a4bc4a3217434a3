"""How parameters are written: into a model, into the delays of commands, into the calibration of signals."""
