"""How the Go1 moves: gaits, steering, the one-leg sweep, and the cost terms of each."""
