"""Assertions about runs for users' tests, and a pytest plugin; slow imports happen on first use."""

from .assertions import assert_equal, assert_settles, assert_within_limits

__all__ = ["assert_equal", "assert_settles", "assert_within_limits"]
