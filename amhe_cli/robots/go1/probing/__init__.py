"""Which pushes make a box's mass and friction visible, and how the Go1 performs them."""
