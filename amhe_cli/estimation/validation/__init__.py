"""Does it predict? Held-out clips, errors against the horizon, and models against each other."""
