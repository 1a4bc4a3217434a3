"""What is wrong with the numbers of a model: against what a robot did, and against another model."""
