"""Conformance tests of estimators: `check_filter` and `check_locator` for your tests."""

from rbl_gym.testing.checks import check_filter, check_locator

__all__ = ["check_filter", "check_locator"]
