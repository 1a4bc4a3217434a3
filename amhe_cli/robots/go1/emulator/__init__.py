"""A Go1 and its cameras on loopback: the robot's own protocol with MuJoCo physics behind it."""
