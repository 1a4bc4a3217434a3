"""Floor 1: rollouts of many candidate parameters at once."""
