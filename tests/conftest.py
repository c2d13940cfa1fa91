"""Settings of all tests."""

from hypothesis import settings

# The same examples at every run: a failure is a fact, not a lottery.
settings.register_profile("rbl", derandomize=True, deadline=None, max_examples=40)
settings.load_profile("rbl")
