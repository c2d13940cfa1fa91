"""Placement studies: design of a layout, its predicted accuracy, the check by filters."""
