"""Floor 1: the Unitree Go1, its numbers, kinematics and models."""
