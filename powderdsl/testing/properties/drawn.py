"""Worlds that Hypothesis draws: it looks for them where random numbers rarely go."""

from __future__ import annotations

import sys
from importlib.util import find_spec

from powderdsl.system.user_cache import cache_folder
from powderdsl.testing.properties.samples import sample_of
from powderdsl.testing.properties.search import InvariantSearch

STEPS = 3


def has_hypothesis() -> bool:
    return find_spec("hypothesis") is not None


def try_drawn(search: InvariantSearch, examples: int) -> int:
    """Hold the properties against so many worlds that Hypothesis draws, the same for the same seed; how many it drew.

    It makes nothing small: `shrink` tries hundreds of smaller worlds in one batch.
    """
    if examples == 0:
        return 0
    if "hypothesis" not in sys.modules:  # it would put a folder of its own into the working directory
        from hypothesis.configuration import set_hypothesis_home_dir

        set_hypothesis_home_dir(cache_folder("hypothesis"))
    from hypothesis import HealthCheck, Phase, given, seed, settings

    from powderdsl.testing.generators.cases import Start
    from powderdsl.testing.strategies import worlds

    count = 0

    @seed(search.plan.seed)
    @settings(
        max_examples=examples,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(worlds(search.runner.ruleset, max_batch=2, max_side=9))
    def run(start: Start) -> None:
        nonlocal count
        count += 1
        search.try_sample(sample_of(start), STEPS)

    run()
    return count
