"""Interface of estimators: the belief, the filter protocol, and the registry of names."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Mapping
from importlib.metadata import entry_points
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, check_array, did_you_mean, imported, parse_filter
from rbl_gym.measurements.bearing import AngleNoise
from rbl_gym.measurements.ranging import NoiseLaw
from rbl_gym.motion.kinematics import ProcessNoise

ENTRY_POINT_GROUP = "rbl_gym.filters"


class PoseBelief(NamedTuple):
    """Belief over a pose, with leading batch axes.

    Attributes
    ----------
    rotation
        (..., 3, 3), always a proper rotation, body to world.
    translation
        (..., 3), metres.
    covariance
        (..., 6, 6) of the error (w, v), ``rotation = exp(w) Q``, ``translation = t + v``.
    matrix
        (..., 3, 3), the raw estimate of the rotation. It is not orthogonal for KF and ET-KF, and
        equals `rotation` for all others.
    """

    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray
    matrix: FloatArray


class Filter(Protocol):
    """Interface of a filter: pure functions on a state that is a NamedTuple of arrays.

    Every array may have leading batch axes; the state is never modified in place.
    """

    def initial(self, rotation: ArrayLike, translation: ArrayLike, covariance: ArrayLike) -> Any:
        """Return the state of a prior: pose (..., 3, 3), (..., 3) and covariance (..., 6, 6)."""
        ...

    def predict(self, state: Any, twist: ArrayLike, dt: float) -> Any:
        """Return the state after `dt` seconds of the twist (..., 6).

        A filter with the attribute ``reads = "inertial"`` takes the readings (..., S, 6) of an
        inertial sensor during that time in place of the twist.
        """
        ...

    def update(
        self,
        state: Any,
        ranges: ArrayLike,
        anchors: ArrayLike,
        links: ArrayLike | None = None,
        noise: NoiseLaw | None = None,
    ) -> Any:
        """Return the state after the ranges (..., M, N) to anchors (..., M, 3).

        `links` (..., M, N) is True where measured; None: all. `noise` is the noise model of this
        epoch; None: the noise model of the filter.
        """
        ...

    def belief(self, state: Any) -> PoseBelief:
        """Return the belief of the state over the pose."""
        ...


_FACTORIES: dict[str, Callable[..., Filter]] = {}


def register(name: str, factory: Callable[..., Filter]) -> None:
    """Register a filter; `factory` takes tags, noise, process and its own options.

    Raises
    ------
    ValueError
        If another factory already has the name.
    """
    if not name or not isinstance(name, str):
        raise ValueError(f"name must be a string, not empty, got {name!r}")
    if not callable(factory):
        raise ValueError(f"factory must be callable, got {factory!r:.80}")
    if "/" in name or "," in name:
        raise ValueError(f"name must have no '/' and no ',', got {name!r}")
    if _FACTORIES.setdefault(name, factory) is not factory:
        raise ValueError(f"filter {name!r} is already registered: choose another name")


def names() -> list[str]:
    """Return the names of all filters, built in or of installed packages (``rbl_gym.filters``)."""
    return sorted({*_FACTORIES, *(entry.name for entry in entry_points(group=ENTRY_POINT_GROUP))})


def make(
    name: str | Callable[..., Filter],
    *,
    tags: ArrayLike,
    noise: NoiseLaw | AngleNoise,
    process: ProcessNoise,
    **options: Any,
) -> Filter:
    """Make a filter by its name, or by a factory.

    Parameters
    ----------
    name
        ``"kf"``, ``"uc-kf"``, ``"et-kf"``, ``"kf-ortho"``, ``"iekf"``, ``"iekf-cv"``,
        ``"iekf-bias"``, ``"iekf-log"``, ``"iekf-imu"``, ``"iekf-bank"``; a name from the
        entry-point group ``rbl_gym.filters`` of another package; or ``"package.module:factory"``,
        which is imported. Options may follow the name, as in ``"iekf/robust=true"``
        (`parse_filter`). Or a factory: a class or a function with the arguments `tags`, `noise`,
        `process` and its own options.
    tags
        (N, 3), positions in the body frame, metres.
    noise
        Noise model of the ranges (`rbl_gym.ranging`); with ``measurement="doa"`` (of ``"iekf"``)
        that of the angles (`rbl_gym.measurements.bearing.AngleNoise`).
    process
        Process noise of the motion.
    **options
        Options of that filter; see its class.

    Raises
    ------
    ValueError
        If the name or an option is unknown or given twice, a factory does not have the three
        arguments, what it makes lacks a method of `Filter`, or an argument is out of range.
    """
    name, options = parse_filter(name, options)
    factory = factory_of(name)
    shown = repr(name) if isinstance(name, str) else getattr(name, "__name__", f"{name!r:.80}")
    tags = check_array("tags", tags, ("N", 3))
    of_ranges = options.get("measurement", "ranges") == "ranges"
    for label, value, methods in (
        ("noise", noise, ("variance", "squared_range_variance") if of_ranges else ("variance",)),
        ("process", process, ("covariance", "std")),
    ):
        if not all(callable(getattr(value, method, None)) for method in methods):
            usual = {"noise": "ranging.RangeNoise", "process": "motion.ProcessNoise"}[label]
            raise ValueError(
                f"{label} must be an object such as {usual}, with the methods "
                f"{' and '.join(methods)}, got {value!r:.80}"
            )
    parameters = inspect.signature(factory).parameters
    takes_any = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
    laws = ("tags", "noise", "process")
    missing = [key for key in laws if not (takes_any or key in parameters)]
    if missing:
        raise ValueError(
            f"filter {shown} must be made by factory(tags=..., noise=..., process=...), but "
            f"its arguments are ({', '.join(parameters)})"
        )
    known = [key for key in parameters if key not in laws]
    unknown = [key for key in options if key in laws or not (takes_any or key in known)]
    if unknown:
        raise ValueError(
            f"filter {shown} has no option {unknown[0]!r}; its options are {', '.join(known)}"
            f"{did_you_mean(unknown[0], known)}"
        )
    made = factory(tags=tags, noise=noise, process=process, **options)
    for method in ("initial", "predict", "update", "belief"):
        if not callable(getattr(made, method, None)):
            raise ValueError(
                f"filter {shown} must have the methods initial, predict, update and belief, "
                f"got {type(made).__name__} without {method}"
            )
    return made


def filter_text(name: str | Callable[..., Filter], options: Mapping[str, Any]) -> str:
    """Return the text of a filter with options; `parse_filter` reads it if they are JSON-able.

    The text of a class or function, which `parse_filter` does not read, begins with its own name.
    """
    text = name if isinstance(name, str) else getattr(name, "__name__", repr(name))
    values = {
        key: x if isinstance(x, str) else json.dumps(x, default=str) for key, x in options.items()
    }
    return "/".join((text, *(f"{key}={value}" for key, value in values.items())))


def factory_of(name: str | Callable[..., Filter]) -> Callable[..., Filter]:
    """Return the factory of a name: registered, of an entry point, or imported; or the factory."""
    if callable(name):
        return name
    if isinstance(name, str) and name in _FACTORIES:
        return _FACTORIES[name]
    found = [entry for entry in entry_points(group=ENTRY_POINT_GROUP) if entry.name == name]
    if found:
        return found[0].load()
    if isinstance(name, str) and ":" in name:
        return imported("filter", name)
    module, dot, factory = name.rpartition(".") if isinstance(name, str) else ("", "", "")
    raise ValueError(
        f"filter must be one of {', '.join(names())}, or a name given by "
        "rbl_gym.estimators.register, or 'module:factory', or a class or function that makes the "
        f"filter, got {name!r:.80}"
        + (f"; did you mean '{module}:{factory}'?" if dot else did_you_mean(name, names()))
    )


def check_takes_noise(name: str | Callable[..., Filter], filter: Filter, why: str) -> None:
    """Raise ValueError if the `update` of a filter has no argument `noise`.

    Parameters
    ----------
    name
        Name or factory of the filter, for the message.
    filter
        The filter.
    why
        What has a noise model for each epoch, for the message.
    """
    parameters = inspect.signature(filter.update).parameters
    if "noise" in parameters or any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
        return
    raise ValueError(
        f"filter {name!r} must take update(state, ranges, anchors, links=None, noise=None), "
        f"because {why}; its update takes ({', '.join(parameters)})"
    )


def belief_of(filter: Filter, state: Any) -> PoseBelief:
    """Return the belief of a filter; raises TypeError if it is no `PoseBelief`."""
    belief = filter.belief(state)
    if getattr(belief, "_fields", None) != PoseBelief._fields:
        raise TypeError(
            f"belief of the filter {type(filter).__name__} must return rbl_gym.estimators."
            f"PoseBelief({', '.join(PoseBelief._fields)}), got a {type(belief).__name__}"
            + (f" of {len(belief)}" if isinstance(belief, tuple | list) else "")
        )
    return belief


def reads(filter: Filter) -> str:
    """Return the input of a filter's `predict`: ``"twist"``, ``"inertial"`` or ``"odometry"``."""
    return getattr(filter, "reads", "twist")


def inverse(matrix: FloatArray) -> FloatArray:
    """Invert symmetric positive definite matrices (..., n, n), symmetric to the last bit."""
    result = np.linalg.inv(matrix)
    return 0.5 * (result + np.swapaxes(result, -1, -2))
