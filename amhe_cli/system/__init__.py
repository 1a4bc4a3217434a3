"""What is known of a robot and its surroundings: models, unknowns, signals. The room of MuJoCo's models."""
