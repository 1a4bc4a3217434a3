"""amhe: physical parameters with honest uncertainty, from robot logs."""

__version__ = "0.1.0"
