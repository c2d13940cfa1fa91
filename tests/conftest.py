"""Settings of all tests."""

import logging
from collections import defaultdict

import pytest
from hypothesis import settings

from rbl_gym import kernels

# The same examples at every run: a failure is a fact, not a lottery.
settings.register_profile("rbl", derandomize=True, deadline=None, max_examples=40)
settings.load_profile("rbl")


# Tests read what commands print. Whether kernels were on disk must not change it.
logging.getLogger("rbl_gym.kernels").setLevel(logging.WARNING)


@pytest.fixture(autouse=True)
def _width_of_no_terminal(monkeypatch):
    """Tables as a pipe prints them, also if the shell exports the width of its terminal."""
    monkeypatch.delenv("COLUMNS", raising=False)


def pytest_addoption(parser):
    parser.addoption(
        "--cases",
        type=int,
        metavar="N",
        help="of each test with more cases run N: the first, the last, and some between",
    )


def pytest_configure(config):
    """Compile the kernels before workers start: each of them would, at the same time."""
    if getattr(config.option, "numprocesses", None) and not hasattr(config, "workerinput"):
        kernels.compile_all()


@pytest.hookimpl(trylast=True)  # after `-m` has left out its own
def pytest_collection_modifyitems(config, items):
    most = config.getoption("cases")
    if most is None:
        return
    cases = defaultdict(list)
    for item in items:
        cases[item.nodeid.partition("[")[0]].append(item)
    kept = set()
    for group in cases.values():
        count = min(most, len(group))
        kept |= {group[k * (len(group) - 1) // max(count - 1, 1)] for k in range(count)}
    config.hook.pytest_deselected(items=[item for item in items if item not in kept])
    items[:] = [item for item in items if item in kept]


@pytest.fixture(scope="module")
def coarse_design():
    """Layouts of `place` with few candidates and positions: tests of how, not of how well."""
    coarse = {
        "rbl_gym.placement.design": {"STAGES": (64, 64, 64), "_CANDIDATES": 120, "_STARTS": 2},
        "rbl_gym.studies.placing.accuracy": {"_MAP": 12, "_LEAST_MAP": 8},
        "rbl_gym.studies.placing.judging": {"PLACES": 120, "MOST_PLACES": 480},
        "rbl_gym.studies.placing.choosing": {"_PLACES": 120, "_LEAST_PLACES": 60},
    }
    with pytest.MonkeyPatch.context() as patch:
        for module, values in coarse.items():
            for name, value in values.items():
                patch.setattr(f"{module}.{name}", value)
        yield


@pytest.fixture
def no_search_for_causes(monkeypatch):
    """A replay that contradicts its filter does not look for the fault, which takes seconds."""
    causes = "rbl_gym.studies.replay.diagnosis.likely_causes"
    monkeypatch.setattr(causes, lambda *_: [])
