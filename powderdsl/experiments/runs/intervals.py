"""Means and their 95 % intervals, over seeds or episodes."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence

T_975 = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228)
"""97.5 % quantiles of Student's t for 1 to 10 degrees of freedom, for which no short formula is exact enough."""


def mean_and_interval(values: Sequence[float]) -> tuple[float, float | None]:
    """The mean, and half of its 95 % interval by Student's t; None for a single value."""
    mean, freedom = statistics.fmean(values), len(values) - 1
    if freedom < 1:
        return mean, None
    # Beyond the table: the expansion of Cornish and Fisher, exact to four digits.
    expansion = 1.95996 + 2.37227 / freedom + 2.8225 / freedom**2 + 2.5557 / freedom**3
    quantile = T_975[freedom - 1] if freedom <= len(T_975) else expansion
    return mean, quantile * statistics.stdev(values) / math.sqrt(len(values))
