"""What is wrong with the numbers of a model, and what a log will say of it, before anything is fitted."""
