"""Floor 3: how a legged robot is moved."""
