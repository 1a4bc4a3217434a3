"""Floor 1: the wire to a real Go1: packets, limits, trips, the state machine, and the process that sends."""
