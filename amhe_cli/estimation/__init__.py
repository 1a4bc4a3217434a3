"""Methods that find parameters, and say how well they are known."""
