"""Recordings as scenes of the benchmark: one body, a real log, the conditions put on top."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.measurements.ranging import LinkModel
from rbl_gym.recordings import Recording, read_recording
from rbl_gym.studies import replay
from rbl_gym.studies.bench import figures
from rbl_gym.studies.bench.worlds import (
    ANCHOR_ERROR_M,
    DROP_PROBABILITY,
    NLOS_PROBABILITY,
    NOISE_FACTOR,
    TAG_ERROR_M,
    off_by,
)

FILES = ("ranges", "anchors", "tags", "truth", "calibration")
# What of `replay.Settings` a recording sets; filters are the benchmark's.
_OF_FILTER = ("filter", "filter_options", "robust")
SETTINGS = tuple(name for name in replay.Settings().flat() if name not in _OF_FILTER)
# Stretches of equal length that stand for trials: errors within one are correlated.
SEGMENTS = 20


class Log(NamedTuple):
    """A recording, how it is filtered, and the digest of all of it."""

    recording: Recording
    settings: replay.Settings
    digest: str


def load_recording(spec: Mapping[str, Any]) -> Log:
    """The recording that a mapping describes: its files, and fields of `replay.Settings`.

    Raises
    ------
    ValueError
        On an unknown key, or one of ranges, anchors, tags and truth that is missing.
    """
    unknown = [key for key in spec if key not in (*FILES, *SETTINGS)]
    if unknown:
        known = ", ".join((*FILES, *SETTINGS))
        raise ValueError(f"a recording has no key {unknown[0]!r}; its keys are {known}")
    for key in FILES[:4]:
        if key not in spec:
            raise ValueError(f"a recording needs the key {key!r}, got {', '.join(spec)}")
    files = [Path(spec[key]).stat() for key in FILES if key in spec]
    stamps = tuple((file.st_mtime_ns, file.st_size) for file in files)
    # What JSON gives as a list cannot be the key of a cache.
    items = ((key, tuple(x) if isinstance(x, list) else x) for key, x in spec.items())
    return _load(tuple(sorted(items)), stamps)


@functools.lru_cache(maxsize=2)
def _load(items: tuple[tuple[str, Any], ...], stamps: tuple[tuple[int, int], ...]) -> Log:
    """`load_recording` of a checked mapping; the stamps tell files that were written again."""
    spec = dict(items)
    paths = {key: spec[key] for key in FILES if key in spec}
    recording = read_recording(**paths)
    settings = replay.Settings.of(**{key: spec[key] for key in SETTINGS if key in spec})
    # Said once and for all: a condition may put an anchor at another height.
    offset = replay.height_offset(recording, settings)
    settings = settings.changed(height_offset_m=offset)
    digest = hashlib.sha256(repr([item for item in items if item[0] not in FILES]).encode())
    for key in sorted(paths):
        digest.update(key.encode() + Path(paths[key]).read_bytes())
    return Log(recording, settings, digest.hexdigest()[:16])


class Stressed(NamedTuple):
    """A recording under a condition, as given to filters."""

    told: Recording
    settings: replay.Settings


def stressed(log: Log, condition: str, seed: int) -> Stressed:
    """The condition put on a recording; its own errors stay what they are."""
    told, settings = log.recording, log.settings
    rng = np.random.default_rng([seed, int(log.digest, 16)])
    if condition == "nlos":
        reflected = (rng.random(told.ranges.shape) < NLOS_PROBABILITY) & told.links
        ranges = told.ranges + LinkModel().nlos_bias_m * reflected
        return Stressed(told._replace(ranges=ranges), settings)
    if condition == "lost-links":
        links = told.links & (rng.random(told.links.shape) >= DROP_PROBABILITY)
        return Stressed(told._replace(links=links, ranges=told.ranges * links), settings)
    if condition == "noise-x2":
        if settings.range_std_m is None and told.range_std is not None:
            return Stressed(told._replace(range_std=told.range_std / NOISE_FACTOR), settings)
        std = (settings.range_std_m or replay.DEFAULT_RANGE_STD_M) / NOISE_FACTOR
        return Stressed(told, dataclasses.replace(settings, range_std_m=std))
    if condition == "anchor-off":
        # The same error all the time, of an anchor that moves too.
        anchors = told.anchors + off_by(np.zeros(told.anchors.shape[-2:]), ANCHOR_ERROR_M, rng)
        return Stressed(told._replace(anchors=anchors), settings)
    if condition == "tag-off":
        return Stressed(told._replace(tags=off_by(told.tags, TAG_ERROR_M, rng)), settings)
    return Stressed(told, settings)


def recording_errors(log: Log, track: replay.Track) -> figures.BenchErrors:
    """Errors where truth is known, its epochs cut into `SEGMENTS` stretches."""
    found = replay.track_errors(log.recording, track, log.settings)
    assert found is not None
    if found.rotation is None or found.tags is None:
        raise ValueError("a recording of the benchmark must have truth with rotations")
    known = np.flatnonzero(found.known)
    count = min(SEGMENTS, len(known))
    length = len(known) // count

    def cut(values: np.ndarray) -> np.ndarray:
        return values[known][: length * count].reshape(count, length).T

    return figures.BenchErrors(
        cut(found.position),
        np.rad2deg(cut(found.rotation)),
        cut(found.tags),
        cut(found.nees),
        found.freedom,
    )
