"""Settings of all tests."""

from hypothesis import settings

from rbl_gym import kernels

# The same examples at every run: a failure is a fact, not a lottery.
settings.register_profile("rbl", derandomize=True, deadline=None, max_examples=40)
settings.load_profile("rbl")


def pytest_configure(config):
    """Compile the kernels before workers start: each of them would, at the same time."""
    if getattr(config.option, "numprocesses", None) and not hasattr(config, "workerinput"):
        kernels.compile_all()
