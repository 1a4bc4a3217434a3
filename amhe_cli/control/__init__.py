"""The Go1 that pushes: its models, legs and gait."""
