"""Assertions about runs for tests of users, and a pytest plugin; nothing heavy is imported before it is used."""

from .assertions import assert_equal, assert_settles, assert_within_limits

__all__ = ["assert_equal", "assert_settles", "assert_within_limits"]
