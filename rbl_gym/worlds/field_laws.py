"""Laws for values of a scene, in dicts and lists as in JSON."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import check_array, check_count, check_number

# Limit of copies, larger than any number of boxes or anchors of a scene.
_MOST_COPIES = 10_000
# Limit of the combinations of choices and ends of integers that are checked for a family.
_MOST_CORNERS = 10_000


class _Law(NamedTuple):
    """A kind of law: functions of its parameters."""

    check: Callable[[str, Any], None]
    draw: Callable[[Any, np.random.Generator], Any]
    # Representative values, and their number.
    ends: Callable[[Any], Iterator[Any]]
    count: Callable[[Any], int]


def check(value: Any, path: str) -> None:
    """Raise ValueError for an invalid law in a nested value."""
    law = _law_of(value)
    if law is not None:
        kind = next(iter(value))
        law.check(f"{path}.{kind}", value[kind])
        return
    for key, item in _items(value):
        check(item, f"{path}[{key}]" if isinstance(value, list | tuple) else f"{path}.{key}")


def draw(value: Any, rng: np.random.Generator) -> Any:
    """Return the nested value with a number for each law, drawn in the order of the value."""
    law = _law_of(value)
    if law is not None:
        return law.draw(next(iter(value.values())), rng)
    if isinstance(value, Mapping):
        return {key: draw(item, rng) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [draw(item, rng) for item in value]
    return value


def ends(value: Any) -> Iterator[Any]:
    """Yield the nested values with all choices and both ends of integers; else midpoints."""
    law = _law_of(value)
    if law is not None:
        yield from law.ends(next(iter(value.values())))
        return
    items = _items(value)
    if not items:
        yield value
        return
    keys = [key for key, _ in items]
    for values in itertools.product(*(list(ends(item)) for _, item in items)):
        found = dict(zip(keys, values, strict=True))
        yield found if isinstance(value, Mapping) else list(found.values())


def count_of_ends(value: Any) -> int:
    """Return the number of `ends`."""
    law = _law_of(value)
    if law is not None:
        return law.count(next(iter(value.values())))
    return math.prod(count_of_ends(item) for _, item in _items(value))


def limits(value: Any) -> tuple[Any, Any]:
    """Return the smallest and the largest number that a checked law draws, or the number twice."""
    law = _law_of(value)
    if law is None:
        return value, value
    ((kind, given),) = value.items()
    if kind == "choice":
        lows, highs = zip(*map(limits, given), strict=True)
        return min(lows), max(highs)
    low, high = given
    return (int(low), int(high)) if kind == "integers" else (low, high)


def corners(value: Any, path: str) -> list[Any]:
    """Return all `ends` of a value after checking it; `path` is its name in errors."""
    check(value, path)
    count = count_of_ends(value)
    if count > _MOST_CORNERS:
        raise ValueError(
            f"{path} must have at most {_MOST_CORNERS} combinations of choices, got {count}"
        )
    return list(ends(value))


def _items(value: Any) -> list[tuple[Any, Any]]:
    """Return the items of a dict or a list, by keys."""
    if isinstance(value, Mapping):
        return list(value.items())
    return list(enumerate(value)) if isinstance(value, list | tuple) else []


def _law_of(value: Any) -> _Law | None:
    """Return the law given by a dict with one key of `_LAWS`; None for other values."""
    if isinstance(value, Mapping) and len(value) == 1:
        return _LAWS.get(next(iter(value)))
    return None


# --- numbers ----------------------------------------------------------------------------------


def _limits(path: str, value: Any) -> tuple[float, float]:
    low, high = check_array(path, value, (2,)).tolist()
    if low > high:
        raise ValueError(f"{path} must be [low, high] with low at most high, got {value!r:.80}")
    return low, high


def _check_uniform(path: str, value: Any) -> None:
    _limits(path, value)


def _check_log_uniform(path: str, value: Any) -> None:
    check_number(f"{path}[0]", _limits(path, value)[0], low=1e-300)


def _check_integers(path: str, value: Any) -> None:
    if any(one != int(one) for one in _limits(path, value)):
        raise ValueError(f"{path} must be two whole numbers, got {value!r:.80}")


def _draw_integer(value: Any, rng: np.random.Generator) -> int:
    return int(rng.integers(int(value[0]), int(value[1]) + 1))


def _ends_of_integers(value: Any) -> Iterator[int]:
    yield from dict.fromkeys(int(one) for one in value)


# --- choices and copies -----------------------------------------------------------------------


def _check_choice(path: str, value: Any) -> None:
    if not isinstance(value, Sequence) or isinstance(value, str) or not value:
        raise ValueError(f"{path} must be a list of values, got {value!r:.80}")
    for index, item in enumerate(value):
        check(item, f"{path}[{index}]")


def _check_repeat(path: str, value: Any) -> None:
    if not isinstance(value, Mapping) or set(value) != {"count", "of"}:
        raise ValueError(f"{path} must be a dict with the keys count and of, got {value!r:.80}")
    numbers = _counts(value)
    if len(numbers) != 2:
        raise ValueError(
            f"{path}.count must be a number or [low, high], got {value['count']!r:.80}"
        )
    for one in numbers:
        check_count(f"{path}.count", one, least=0, most=_MOST_COPIES)
    _check_integers(f"{path}.count", numbers)
    check(value["of"], f"{path}.of")


def _counts(value: Mapping[str, Any]) -> list[Any]:
    count = value["count"]
    return list(count) if isinstance(count, Sequence) else [count, count]


def _draw_copies(value: Mapping[str, Any], rng: np.random.Generator) -> list[Any]:
    return [draw(value["of"], rng) for _ in range(_draw_integer(_counts(value), rng))]


def _ends_of_copies(value: Mapping[str, Any]) -> Iterator[list[Any]]:
    for count in _ends_of_integers(_counts(value)):
        for one in ends(value["of"]):
            yield [one] * count


_LAWS: dict[str, _Law] = {
    "uniform": _Law(
        _check_uniform,
        lambda value, rng: float(rng.uniform(*value)),
        lambda value: iter((0.5 * (value[0] + value[1]),)),
        lambda value: 1,
    ),
    "log-uniform": _Law(
        _check_log_uniform,
        lambda value, rng: math.exp(rng.uniform(*np.log(value))),
        lambda value: iter((math.sqrt(value[0] * value[1]),)),
        lambda value: 1,
    ),
    "integers": _Law(
        _check_integers, _draw_integer, _ends_of_integers, lambda value: len(set(value))
    ),
    "choice": _Law(
        _check_choice,
        lambda value, rng: draw(value[int(rng.integers(len(value)))], rng),
        lambda value: itertools.chain.from_iterable(ends(item) for item in value),
        lambda value: sum(count_of_ends(item) for item in value),
    ),
    "repeat": _Law(
        _check_repeat,
        _draw_copies,
        _ends_of_copies,
        lambda value: len(set(_counts(value))) * count_of_ends(value["of"]),
    ),
}
