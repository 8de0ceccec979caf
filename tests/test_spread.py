"""The interquartile mean and its interval, by hand."""

import numpy as np
import pytest

from cassie_mjx.reporting.spread import spread


def test_the_interquartile_mean_leaves_out_the_outer_quarters():
    found = spread([0, 1, 2, 3, 4, 5, 6, 100])
    assert found.iqm == 3.5
    assert (found.least, found.greatest, found.seeds) == (0, 100, 8)


def test_of_few_seeds_it_is_the_mean_and_there_is_no_interval():
    assert spread([1, 2, 6])[:2] == (3, None)


def test_the_interval_covers_the_truth_about_as_often_as_it_says():
    """Of ten normal values; a percentile interval of so few is a little too narrow."""
    rng = np.random.default_rng(0)
    intervals = [spread(rng.normal(size=10).tolist()).interval or (0.0, 0.0) for _ in range(100)]
    assert 80 <= sum(low < 0 < high for low, high in intervals) <= 99


def test_equal_values_are_sure():
    assert spread([7.0] * 10)[:2] == (7, (7, 7))


def test_the_same_seeds_always_have_the_same_interval():
    values = [1, 2, 4, 8, 16, 32]
    assert spread(values) == spread(values)
    found = spread(values)
    assert found.interval is not None
    assert 1 <= found.interval[0] < found.iqm < found.interval[1] <= 32
    assert found.interval != pytest.approx((1, 32))
