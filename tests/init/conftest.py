"""The small systems of the tests of `system`, for those of `init`."""

from tests.system.conftest import written as written
