"""Floor 4: a Go1 and its cameras on loopback: the robot's own protocol, MuJoCo physics behind it."""
