"""What several training seeds say together: their interquartile mean, how sure it is, and the extremes."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import bootstrap, trim_mean

FEWEST = 5
"""Seeds from which on there is an interval."""


class Spread(NamedTuple):
    """Of one value a seed."""

    iqm: float
    """Interquartile mean, the mean of the middle half; of fewer than four values, the mean."""
    interval: tuple[float, float] | None
    """Its 95% bootstrap interval; None of fewer than `FEWEST` values."""
    least: float
    greatest: float
    seeds: int


def spread(values: Sequence[float]) -> Spread:
    """What these values, one a seed, say together.

    The interquartile mean with a bootstrap interval is what Agarwal et al., "Deep Reinforcement Learning at the Edge of
    the Statistical Precipice" (2021), recommend for few seeds.

    Args:
      values: at least one.
    """
    least, greatest = float(min(values)), float(max(values))
    interval = None
    if len(values) >= FEWEST:
        interval = (least, greatest) if least == greatest else _bootstrap(values)
    return Spread(float(_iqm(values)), interval, least, greatest, len(values))


def _iqm(values: Sequence[float] | np.ndarray, axis: int = 0) -> np.ndarray:
    return trim_mean(values, 0.25, axis=axis)


def _bootstrap(values: Sequence[float]) -> tuple[float, float]:
    """The percentile interval of 10,000 resamples, which are the same every time."""
    drawn = bootstrap((np.asarray(values),), _iqm, n_resamples=10_000, method="percentile", rng=0)
    low, high = drawn.confidence_interval
    return float(low), float(high)
