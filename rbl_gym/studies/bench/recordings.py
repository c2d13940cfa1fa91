"""Use recordings as scenes of the benchmark: one body, a real log, with added conditions."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import did_you_mean
from rbl_gym.measurements.ranging import LinkModel
from rbl_gym.recordings import Files, Recording, read_recording
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
# Settings that a recording may set; the filter is chosen by the benchmark.
_OF_FILTER = ("filter", "filter_options", "robust")
SETTINGS = tuple(name for name in replay.Settings().flat() if name not in _OF_FILTER)
# Number of segments of equal length that serve as trials; errors within one are correlated.
SEGMENTS = 20


class Log(NamedTuple):
    """A recording, its settings, and the digest of all its inputs."""

    recording: Recording
    settings: replay.Settings
    digest: str


def load_recording(spec: Mapping[str, Any]) -> Log:
    """Return the recording described by a mapping: its files, and fields of `replay.Settings`.

    ValueError if a key is unknown, or ranges, anchors, tags or truth are missing.
    """
    unknown = [key for key in spec if key not in (*FILES, *SETTINGS)]
    if unknown:
        known = ", ".join((*FILES, *SETTINGS))
        near = did_you_mean(unknown[0], (*FILES, *SETTINGS))
        raise ValueError(f"a recording has no key {unknown[0]!r}; its keys are {known}{near}")
    for key in FILES[:4]:
        if key not in spec:
            raise ValueError(f"a recording needs the key {key!r}, got {', '.join(spec)}")
    files = [Path(spec[key]).stat() for key in FILES if key in spec]
    stamps = tuple((file.st_mtime_ns, file.st_size) for file in files)
    # Lists from JSON are not hashable, as the cache needs.
    items = ((key, tuple(x) if isinstance(x, list) else x) for key, x in spec.items())
    return _load(tuple(sorted(items)), stamps)


@functools.lru_cache(maxsize=2)
def _load(items: tuple[tuple[str, Any], ...], stamps: tuple[tuple[int, int], ...]) -> Log:
    """Load the recording of a checked mapping; the stamps identify files that have changed."""
    spec = dict(items)
    paths = {key: spec[key] for key in FILES if key in spec}
    recording = read_recording(Files(**paths))
    settings = replay.Settings.of(**{key: spec[key] for key in SETTINGS if key in spec})
    # The offset is fixed here, because a condition may change the height of an anchor.
    offset = replay.height_offset(recording, settings)
    settings = settings.changed(height_offset_m=offset)
    digest = hashlib.sha256(repr([item for item in items if item[0] not in FILES]).encode())
    for key in sorted(paths):
        digest.update(key.encode() + Path(paths[key]).read_bytes())
    return Log(recording, settings, digest.hexdigest()[:16])


def stressed(log: Log, condition: str, seed: int) -> tuple[Recording, replay.Settings]:
    """Return recording and settings under a condition, as given to filters.

    The condition adds to the errors that the recording already has.
    """
    told, settings = log.recording, log.settings
    rng = np.random.default_rng([seed, int(log.digest, 16)])
    if condition == "nlos":
        reflected = (rng.random(told.ranges.shape) < NLOS_PROBABILITY) & told.links
        ranges = told.ranges + LinkModel().nlos_bias_m * reflected
        return told._replace(ranges=ranges), settings
    if condition == "lost-links":
        links = told.links & (rng.random(told.links.shape) >= DROP_PROBABILITY)
        return told._replace(links=links, ranges=told.ranges * links), settings
    if condition == "noise-x2":
        if settings.range_std_m is None and told.range_std is not None:
            return told._replace(range_std=told.range_std / NOISE_FACTOR), settings
        std = (settings.range_std_m or replay.DEFAULT_RANGE_STD_M) / NOISE_FACTOR
        return told, dataclasses.replace(settings, range_std_m=std)
    if condition == "anchor-off":
        # The error is constant, also for a moving anchor.
        anchors = told.anchors + off_by(np.zeros(told.anchors.shape[-2:]), ANCHOR_ERROR_M, rng)
        return told._replace(anchors=anchors), settings
    if condition == "tag-off":
        return told._replace(tags=off_by(told.tags, TAG_ERROR_M, rng)), settings
    return told, settings


def recording_errors(log: Log, track: replay.Track) -> figures.BenchErrors:
    """Return the errors at epochs with truth, split into `SEGMENTS` segments."""
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
