"""MPOPI, its splines, the controller, and the protocols of what it controls."""
