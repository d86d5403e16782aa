"""Random damage to rule files: loading raises nothing but CompileError, and what it raises can be printed.

`python -m tests.fuzz --front-end --seeds 0..20000` looks harder, and at time and memory; so do the campaign, which reduces
what it finds, and ``FUZZ_EXAMPLES=20000 pytest --slow tests/diagnostics/test_fuzz.py``.
"""

from __future__ import annotations

import os

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from powderdsl.testing.generators.strategies import chosen
from tests.fuzz.damage import (
    KINDS,
    load_damaged,
    run_trial,
)
from tests.tiers import tiered

SMOKE = 20
EXAMPLES = int(os.environ.get("FUZZ_EXAMPLES", "2000"))
"""Examples of each kind in the smoke test and in the campaign."""

FEWER = {"heavy": 10, "random rules": 3}
"""Kinds that take long, or many choices: so many times fewer examples."""

SEEDS = 60


@pytest.mark.parametrize("examples", tiered((SMOKE, EXAMPLES), [SMOKE]))
@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files(kind: str, examples: int) -> None:
    @settings(
        max_examples=max(1, examples // FEWER.get(kind, 1)),
        deadline=None,
        derandomize="FUZZ_EXAMPLES" not in os.environ,
        database=None,
        suppress_health_check=[
            HealthCheck.too_slow,
            HealthCheck.data_too_large,
            HealthCheck.filter_too_much,
            HealthCheck.large_base_example,
        ],
    )
    @given(chosen(KINDS[kind][1]))
    def run(text: str) -> None:
        load_damaged(text)

    run()


@pytest.mark.parametrize("examples", tiered((SMOKE, EXAMPLES), [SMOKE]))
def test_any_text(examples: int) -> None:
    @settings(max_examples=examples, deadline=None, derandomize=True, database=None)
    @given(st.text(max_size=200))
    def run(text: str) -> None:
        load_damaged(text)

    run()


@pytest.mark.parametrize("seeds", tiered((SEEDS, 20 * SEEDS), [SEEDS]))
def test_seeded_damage(seeds: int) -> None:
    """The first inputs of `python -m tests.fuzz --front-end`: of every kind, and not all of them refused at once."""
    trials = [run_trial(seed) for seed in range(seeds)]
    assert {trial.kind for trial in trials} == set(KINDS)
    assert sum(trial.accepted for trial in trials) >= seeds // 50
    wrong = [trial for trial in trials if trial.problem is not None and not trial.problem.startswith("took")]
    assert wrong == []
