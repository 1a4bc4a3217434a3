"""What a model lacks: unexplained forces along the measured motion, regressed on what usually is missing."""
