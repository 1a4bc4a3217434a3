"""The made-up cart of the online estimator's tests."""

from tests.estimation.online.conftest import cart, drive, folder

__all__ = ["cart", "drive", "folder"]
