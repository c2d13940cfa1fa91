"""Check that truth and ranges overlap in time, and find hints on their clocks and units."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.recordings.truth import Truth
from rbl_gym.studies.replay.truth import matched

# Epochs further apart than this are rarely in seconds.
_LONG_STEP_S = 10.0
_SI = ((1e-3, "milli", "ms"), (1e-6, "micro", "us"), (1e-9, "nano", "ns"))


def check_overlap(truth: Truth, times: FloatArray, gap_s: float, told_s: float = 0.0) -> None:
    """Raise ValueError with the gap if no epoch would have truth.

    `told_s` is the time offset by which the truth has been corrected.
    """
    still = np.broadcast_to(np.eye(3), (len(times), 3, 3)), np.zeros((len(times), 3))
    if matched(truth, times, *still, gap_s)[2].any():
        return
    spans = [f"{seconds_text(t[0])} to {seconds_text(t[-1])} s" for t in (times, truth.times)]
    where = f"ranges {spans[0]}, truth {spans[1]}"
    apart = max(truth.times[0] - times[-1], times[0] - truth.times[-1])
    hints = "".join(f"; {hint}" for hint in stamp_hints(times, truth))
    if apart > 0:
        if not hints and (offset := rough_offset(times, truth)):
            total = offset + told_s
            side = "ahead" if total > 0 else "behind"
            hints = (
                f"; the truth's clock may be {side} by about {seconds_text(abs(total))} s: see "
                f"--time-offset ({seconds_text(total)}, or auto)"
            )
        raise ValueError(
            f"no epoch has truth, as the truth does not overlap with the ranges in time: {where}, "
            f"{apart:.4g} s apart{hints}"
        )
    gaps = [f"{np.diff(t).min():.4g} s" if len(t) > 1 else "one pose" for t in (truth.times, times)]
    raise ValueError(
        f"no epoch has truth, as gaps above {gap_s:g} s are not bridged; the shortest gaps are "
        f"{gaps[0]} in the truth and {gaps[1]} in the ranges ({where}); see --truth-gap-s{hints}"
    )


def rough_offset(times: FloatArray, truth: Truth) -> float:
    """Return by how much the truth starts later, if both are of about one run; 0: they are not."""
    shift = float(truth.times[0] - times[0])
    longest = max(np.ptp(times), np.ptp(truth.times))
    same = abs(np.ptp(times) - np.ptp(truth.times)) < 0.2 * longest < 0.2 * abs(shift)
    return shift if same else 0.0


def seconds_text(seconds: float) -> str:
    """Return seconds with their milliseconds, without zeros at the end.

    Stamps since 1970 have ten digits before the point.
    """
    return f"{seconds:.3f}".rstrip("0").rstrip(".")


def stamp_hints(times: FloatArray, truth: Truth | None) -> Iterator[str]:
    """Yield hints on time stamps that seem to have another unit than seconds."""
    step = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    if truth is not None and len(truth.times) > 1 and len(times) > 1:
        ratio = float(np.ptp(times) / np.ptp(truth.times))
        for name, value in (("ranges", ratio), ("truth", 1 / max(ratio, 1e-30))):
            option = "--time-unit {}" if name == "ranges" else "--columns truth.time=NAME[{}]"
            for scale, prefix, unit in _SI:
                # Logs of the same run are about equally long.
                if 0.2 < value * scale < 5:
                    yield (
                        f"the stamps of the {name} look like {prefix}seconds: they span "
                        f"{value:.4g} times as long as the others; set {option.format(unit)}"
                    )
                    return
    if step >= _LONG_STEP_S:
        yield f"epochs are {step:.4g} s apart (median): are their stamps milliseconds?"
