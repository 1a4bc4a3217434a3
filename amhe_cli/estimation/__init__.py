"""Floor 3: methods that find parameters, and say how well they are known."""
