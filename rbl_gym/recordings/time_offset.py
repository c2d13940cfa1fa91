"""Estimate the offset of two clocks: the shift at which signals of the same motion agree.

The signals may be any quantity measured with both clocks: speeds, turn rates, positions. Their
sampling may differ and be irregular.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from rbl_gym.checks import BoolArray, FloatArray, check_array, check_number

__all__ = ["TimeOffset", "time_offset"]

# Grid points per standard deviation of the smoothing.
_FINE = 2
# Gaps of more than this number of median steps are not bridged.
_GAP = 5.0
# Minimum overlap, as a share of the shorter signal, and in points.
_OVERLAP, _FEWEST = 0.5, 20
# Correlations below the first number are chance. Another offset explains the signals equally well
# if its lack of correlation is below this multiple of that of the best, and below this value.
_LEAST, _RIVAL, _AS_GOOD = 0.3, 1.2, 5e-3
# Smoothing is doubled, up to this number of widths, until the correlation is above the second
# number or grows by less than the third.
_DOUBLINGS, _SMOOTH, _GAIN = 5, 0.9, 0.01
# Number of parts of the record whose scores give the standard deviation.
_PARTS = 24
_MOST_POINTS = 5_000_000


class TimeOffset(NamedTuple):
    """The offset of two clocks: stamp t of the first is ``t + offset_s`` on the second.

    Attributes
    ----------
    offset_s, std_s
        The offset and its standard deviation, seconds.
    correlation
        Correlation of the two smoothed signals at this offset.
    """

    offset_s: float
    std_s: float
    correlation: float


class _Signal(NamedTuple):
    """A signal on a regular grid: start (s), values (n, D) of mean 0, mask of known values (n,)."""

    start: float
    values: FloatArray
    known: BoolArray


def time_offset(
    times_a: ArrayLike,
    values_a: ArrayLike,
    times_b: ArrayLike,
    values_b: ArrayLike,
    search_s: float | None = None,
    smooth_s: float | None = None,
) -> TimeOffset:
    """Estimate the offset at which two signals agree best: ``values_a(t) = values_b(t + offset)``.

    Both are smoothed and interpolated onto a grid. The offset with the highest correlation is
    refined by Gauss-Newton steps on the squared difference of the signals. Gains and constant
    offsets of the values have no effect.

    Parameters
    ----------
    times_a, times_b
        (K,) and (L,), seconds, increasing, any spacing.
    values_a, values_b
        (K,) and (L,), or (K, D) and (L, D): D signals in one unit, used together.
    search_s
        Offsets up to this magnitude are tried; None: all with an overlap of at least half of the
        shorter signal.
    smooth_s
        Standard deviation of the Gaussian smoothing, the same for both; None: the larger of the two
        median steps, doubled while the correlation is poor and improves.

    Returns
    -------
    TimeOffset
        The standard deviation is computed from the scores of parts of the record. It is valid for
        errors that are correlated in time over less than one part (a 24th of the record).

    Raises
    ------
    ValueError
        If the signals do not overlap, do not correlate, or agree equally well at another offset
        (periodic motion).
    """
    a, b = _checked("a", times_a, values_a), _checked("b", times_b, values_b)
    if a[1].shape[1] != b[1].shape[1]:
        raise ValueError(
            f"values_a and values_b must have the same number of columns, got {a[1].shape[1]} and "
            f"{b[1].shape[1]}"
        )
    coarsest = max(float(np.median(np.diff(times))) for times, _ in (a, b))
    search = np.inf if search_s is None else check_number("search_s", search_s, low=0.0)
    if smooth_s is None:
        widths = [coarsest * 2**n for n in range(_DOUBLINGS)]
    else:
        widths = [check_number("smooth_s", smooth_s, low=1e-9)]
    best: TimeOffset | None = None
    failed: ValueError | None = None
    for width in widths:
        step = max(width, coarsest) / _FINE
        try:
            one, other = (_on_grid(*signal, step, width) for signal in (a, b))
            start, correlation = _coarse(one, other, step, search)
            found = TimeOffset(*_refined(one, other, step, start), correlation)
        except ValueError as error:
            # More smoothing may remove noise. The first error message is the clearest.
            failed = failed or error
            continue
        if best is not None and correlation < best.correlation + _GAIN:
            break
        best = found
        if correlation > _SMOOTH:
            break
    if best is None:
        raise failed or ValueError("signals do not agree at any offset: give the offset")
    return best


def _checked(name: str, times: ArrayLike, values: ArrayLike) -> tuple[FloatArray, FloatArray]:
    times = check_array(f"times_{name}", times, ("K",))
    values = np.asarray(values, dtype=np.float64)
    values = check_array(f"values_{name}", values[:, None] if values.ndim == 1 else values,
                         ("K", "D"))  # fmt: skip
    if times.ndim != 1 or values.ndim != 2 or len(times) != len(values):
        raise ValueError(
            f"times_{name} must be (K,) and values_{name} (K,) or (K, D), got {times.shape} "
            f"and {values.shape}"
        )
    if len(times) < _FEWEST or (np.diff(times) <= 0).any():
        raise ValueError(
            f"times_{name} must increase strictly and have at least {_FEWEST} entries, got "
            f"{times!s:.80}"
        )
    return times, values


def _on_grid(times: FloatArray, values: FloatArray, step: float, width: float) -> _Signal:
    count = int(np.ptp(times) / step) + 1
    if count > _MOST_POINTS:
        raise ValueError(
            f"times must span at most {_MOST_POINTS} steps of {step:.3g} s, got {np.ptp(times):.3g}"
        )
    grid = times[0] + step * np.arange(count)
    after = np.clip(np.searchsorted(times, grid, side="right"), 1, len(times) - 1)
    gap = times[after] - times[after - 1]
    # A gap between two slow samples of a fast signal is still a gap.
    known = gap <= max(_GAP * float(np.median(np.diff(times))), 2 * width)
    columns = [np.interp(grid, times, column) for column in values.T]
    weight = scipy.ndimage.gaussian_filter1d(known.astype(float), width / step, mode="constant")
    smooth = [
        scipy.ndimage.gaussian_filter1d(np.where(known, column, 0.0), width / step, mode="constant")
        for column in columns
    ]
    result = np.stack(smooth, axis=-1) / np.maximum(weight, 1e-9)[:, None]
    # At an end the smoothing looks to one side.
    known &= weight > 0.8
    if known.sum() < _FEWEST:
        raise ValueError(
            f"signals must have at least {_FEWEST} points outside gaps, got {known.sum()}"
        )
    result = np.where(known[:, None], result - result[known].mean(axis=0), 0.0)
    return _Signal(float(times[0]), result, known)


def _coarse(a: _Signal, b: _Signal, step: float, search: float) -> tuple[float, float]:
    """Return the offset on the grid with the highest correlation, and that correlation."""

    def lagged(x: FloatArray, y: FloatArray) -> FloatArray:
        """Return ``sum_k x[k] y[k + lag]`` for lags from -(len(x) - 1)."""
        count = len(x) + len(y) - 1
        size = 1 << (count - 1).bit_length()
        spectrum = np.fft.rfft(y, size) * np.fft.rfft(x[::-1], size)
        return np.fft.irfft(spectrum, size)[:count]

    m, n = a.known.astype(float), b.known.astype(float)
    common = np.round(lagged(m, n))
    offsets = b.start - a.start + step * (np.arange(len(common)) - (len(m) - 1))
    shared = common >= max(_OVERLAP * min(m.sum(), n.sum()), _FEWEST)
    tried = shared & (np.abs(offsets) <= search + 1e-9)
    if not tried.any():
        raise ValueError(
            "signals overlap too little at all offsets"
            + ("" if np.isinf(search) else f" of up to {search:g} s")
        )
    cross, power_a, power_b = (np.zeros(len(common)) for _ in range(3))
    most = np.maximum(common, 1)
    for x, y in zip(a.values.T, b.values.T, strict=True):
        sum_a, sum_b = lagged(x, n), lagged(m, y)
        cross += lagged(x, y) - sum_a * sum_b / most
        power_a += lagged(x**2, n) - sum_a**2 / most
        power_b += lagged(m, y**2) - sum_b**2 / most
    power = np.sqrt(np.maximum(power_a, 0) * np.maximum(power_b, 0))
    # If one of the signals is constant over the overlap, the correlation is unknown.
    flat = power <= 1e-6 * np.sqrt((a.values**2).sum() * (b.values**2).sum())
    correlation = np.where(tried & ~flat, cross / np.where(flat, 1.0, power), -1.0)
    best = int(correlation.argmax())
    if correlation[best] < _LEAST:
        raise ValueError(
            f"signals do not agree at any offset: the highest correlation is "
            f"{correlation[best]:.2f}, at {offsets[best]:.4g} s"
        )
    ends = np.flatnonzero(tried)[[0, -1]]
    if best in ends and ends[0] != ends[1]:
        raise ValueError(
            f"signals agree best at the end of the search, {offsets[best]:.4g} s, so the offset is "
            "outside of it or not determined"
        )
    _check_rivals(offsets, correlation, best)
    return float(offsets[best]), float(correlation[best])


def _check_rivals(offsets: FloatArray, correlation: FloatArray, best: int) -> None:
    """Raise ValueError if another peak is as high."""
    inner = correlation[1:-1]
    peaks = 1 + np.flatnonzero((inner >= correlation[:-2]) & (inner > correlation[2:]))
    # A peak that no valley separates from the best one belongs to it.
    low = 0.5 * (correlation[best] + min(_LEAST, correlation[best]))
    below = np.flatnonzero(correlation < max(low, 1 - 4 * (1 - correlation[best])))
    left = below[below < best].max(initial=-1)
    right = below[below > best].min(initial=len(correlation))
    others = peaks[(peaks < left) | (peaks > right)]
    if len(others) == 0:
        return
    rival = others[correlation[others].argmax()]
    if 1 - correlation[rival] < _RIVAL * (1 - correlation[best]) + _AS_GOOD:
        raise ValueError(
            f"signals agree as well at an offset of {offsets[rival]:.4g} s as at "
            f"{offsets[best]:.4g} s (correlations {correlation[rival]:.3f} and "
            f"{correlation[best]:.3f}): periodic motion"
        )


def _refined(a: _Signal, b: _Signal, step: float, offset: float) -> tuple[float, float]:
    """Return the least-squares offset near `offset`, and its standard deviation."""
    grid_a = step * np.arange(len(a.values))
    grid_b = step * np.arange(len(b.values))
    spline = scipy.interpolate.CubicSpline
    spline_a, spline_b = spline(grid_a, a.values), spline(grid_b, b.values)
    rate_a = spline_a(grid_a, 1)
    # Stamps since 1970 have few digits left, so the shift is taken between the two starts.
    apart = b.start - a.start
    first = shift = offset - apart
    for _ in range(20):
        at = grid_a + shift
        before = np.floor(at / step).astype(int)
        inside = a.known & (before >= 0) & (before + 1 < len(grid_b))
        used = np.flatnonzero(inside)
        used = used[b.known[before[used]] & b.known[before[used] + 1]]
        x, y, rate = a.values[used], spline_b(at[used]), spline_b(at[used], 1)
        x, y = x - x.mean(axis=0), y - y.mean(axis=0)
        gain = (x * y).sum() / max((y * y).sum(), 1e-300)
        score = ((x - gain * y) * rate).sum(axis=-1)
        # The noise of a signal is only in its own rate, so the product of both rates is unbiased.
        slope = float((rate_a[used] * rate).sum())
        if not slope > 0:
            raise ValueError(f"signals do not change enough to tell an offset near {offset:.4g} s")
        move = float(np.clip(score.sum() / slope, -step, step))
        shift += move
        if abs(move) < 1e-9 * step or abs(shift - first) > 5 * step:
            break
    parts = np.array([part.sum() for part in np.array_split(score, _PARTS)])
    variance = _PARTS / (_PARTS - 1) * ((parts - parts.mean()) ** 2).sum() / slope**2
    return float(apart + shift), float(np.sqrt(variance))
