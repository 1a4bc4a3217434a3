"""Model files, MJCF or URDF, and what a MuJoCo model says of itself: gaps, couplings."""
