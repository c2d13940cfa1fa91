"""What an estimator is: the belief it returns, the interface of a filter, the registry of names."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable
from importlib.metadata import entry_points
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, check_array
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
        (..., 3, 3), the raw estimate of the rotation: of KF and ET-KF not orthogonal, of all
        others the rotation itself.
    """

    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray
    matrix: FloatArray


class Filter(Protocol):
    """The interface of a filter: pure functions on a state that is a NamedTuple of arrays.

    Every array may have leading batch axes; the state is never changed in place.
    """

    def initial(self, rotation: ArrayLike, translation: ArrayLike, covariance: ArrayLike) -> Any:
        """State of a prior: pose (..., 3, 3), (..., 3) and its covariance (..., 6, 6)."""
        ...

    def predict(self, state: Any, twist: ArrayLike, dt: float) -> Any:
        """State after `dt` seconds of the twist (..., 6).

        A filter with the attribute ``reads = "inertial"`` takes the readings (..., S, 6) of an
        inertial sensor in that time in place of it.
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
        """State after the ranges (..., M, N) to anchors (..., M, 3).

        `links` (..., M, N) is True where measured; None: all. `noise` is the law of this epoch;
        None: the law that the filter was made with.
        """
        ...

    def belief(self, state: Any) -> PoseBelief:
        """What the state says about the pose."""
        ...


_FACTORIES: dict[str, Callable[..., Filter]] = {}


def register(name: str, factory: Callable[..., Filter]) -> None:
    """Put a filter under a name; `factory` takes tags, noise, process and its own options.

    Raises
    ------
    ValueError
        If another factory already has the name.
    """
    if not name or not isinstance(name, str) or not callable(factory):
        raise ValueError(f"name and factory must be a string and a callable, got {name!r}")
    if _FACTORIES.setdefault(name, factory) is not factory:
        raise ValueError(f"filter {name!r} is already registered")


def names() -> list[str]:
    """Names of all filters: ours, and those of installed packages (group ``rbl_gym.filters``)."""
    return sorted({*_FACTORIES, *(entry.name for entry in entry_points(group=ENTRY_POINT_GROUP))})


def make(
    name: str,
    *,
    tags: ArrayLike,
    noise: NoiseLaw | AngleNoise,
    process: ProcessNoise,
    **options: Any,
) -> Filter:
    """A filter by its name.

    Parameters
    ----------
    name
        ``"kf"``, ``"uc-kf"``, ``"et-kf"``, ``"kf-ortho"``, ``"iekf"``, ``"iekf-cv"``,
        ``"iekf-bias"``, ``"iekf-imu"``, ``"iekf-bank"``; one that a package offers by the
        entry-point group ``rbl_gym.filters``; or ``"package.module:factory"``, which is imported.
    tags
        (N, 3), places on the body, metres, body frame.
    noise
        Law of the ranges (`rbl_gym.ranging`); with ``measurement="doa"`` (of ``"iekf"``) that of
        the angles (`rbl_gym.measurements.bearing.AngleNoise`).
    process
        Noise of the motion.
    **options
        Of that filter; see its class.

    Raises
    ------
    ValueError
        On an unknown name or option, or an argument out of its range.
    """
    factory = factory_of(name)
    tags = check_array("tags", tags, ("N", 3))
    of_ranges = options.get("measurement", "ranges") == "ranges"
    for label, value, methods in (
        ("noise", noise, ("variance", "squared_range_variance") if of_ranges else ("variance",)),
        ("process", process, ("covariance", "std")),
    ):
        if not all(callable(getattr(value, method, None)) for method in methods):
            raise ValueError(f"{label} must have {' and '.join(methods)}, got {value!r:.80}")
    parameters = inspect.signature(factory).parameters
    takes_any = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
    unknown = [] if takes_any else [key for key in options if key not in parameters]
    if unknown:
        known = [key for key in parameters if key not in ("tags", "noise", "process")]
        raise ValueError(f"filter {name!r} has no option {unknown[0]!r}; it has {', '.join(known)}")
    return factory(tags=tags, noise=noise, process=process, **options)


def factory_of(name: str) -> Callable[..., Filter]:
    """What makes the filters of a name: registered, of an entry point, or to be imported."""
    if isinstance(name, str) and name in _FACTORIES:
        return _FACTORIES[name]
    found = [entry for entry in entry_points(group=ENTRY_POINT_GROUP) if entry.name == name]
    if found:
        return found[0].load()
    if isinstance(name, str) and ":" in name:
        module, _, attribute = name.partition(":")
        try:
            factory: Callable[..., Filter] = getattr(importlib.import_module(module), attribute)
        except (ImportError, AttributeError, ValueError) as error:
            raise ValueError(f"filter {name!r:.80} cannot be imported: {error}") from error
        if not callable(factory):
            raise ValueError(f"filter {name!r:.80} must be callable, got {factory!r:.80}")
        return factory
    raise ValueError(
        f"filter must be one of {', '.join(names())}, or a name given by "
        f"rbl_gym.estimators.register, or 'module:factory', got {name!r:.80}"
    )


def check_takes_noise(name: str, filter: Filter, why: str) -> None:
    """A ValueError that names a filter whose `update` has no argument `noise`.

    Parameters
    ----------
    name
        Of the filter, for the message.
    filter
        The filter.
    why
        What has a law of its own for each epoch, for the message.
    """
    parameters = inspect.signature(filter.update).parameters
    if "noise" in parameters or any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
        return
    raise ValueError(
        f"filter {name!r} must take update(state, ranges, anchors, links=None, noise=None), "
        f"because {why}; its update takes ({', '.join(parameters)})"
    )


def reads(filter: Filter) -> str:
    """What the `predict` of a filter is told: ``"twist"``, ``"inertial"`` or ``"odometry"``."""
    return getattr(filter, "reads", "twist")


def inverse(matrix: FloatArray) -> FloatArray:
    """Inverse of symmetric positive definite matrices (..., n, n), symmetric to the last bit."""
    result = np.linalg.inv(matrix)
    return 0.5 * (result + np.swapaxes(result, -1, -2))
