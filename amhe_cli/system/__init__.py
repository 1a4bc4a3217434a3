"""A system: the model, its unknowns, and how logged signals meet the model."""
