"""`rbl_gym.measurements.ranging` by its short name: noise laws, links and simulated ranges."""

from rbl_gym.measurements.ranging import (
    NOISE_LAWS,
    LinkModel,
    LinkNoise,
    Measurement,
    NoiseLaw,
    RangeNoise,
    SquaredRangeNoise,
    distances,
    measure,
    reference_range,
    simulate,
    tag_positions,
)

__all__ = [
    "NOISE_LAWS",
    "LinkModel",
    "LinkNoise",
    "Measurement",
    "NoiseLaw",
    "RangeNoise",
    "SquaredRangeNoise",
    "distances",
    "measure",
    "reference_range",
    "simulate",
    "tag_positions",
]
