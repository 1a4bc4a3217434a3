"""The UDP link to a Go1: packets, limits, trips, the state machine, and the process that sends."""
