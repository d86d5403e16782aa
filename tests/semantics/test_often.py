"""`often`: chances that tests of packs claim, and how sharply counts judge them."""

from __future__ import annotations

import math

import pytest

from powderdsl.testing.pack_tests.runner import ERROR_RATE, OFF, RARE, is_unlikely, run_examples, trials_for
from tests.semantics.texts import load_text, mistakes
from tests.tiers import tiered

PACK = """\
pack: coins
params: {melt: 2%}
elements:
  floor: {id: 0, color: "#101010", glyph: "."}
  coin: {id: 1, color: "#202020", glyph: c}
  gold: {id: 2, color: "#303030", glyph: g}
passes:
  melt:
    do: coin -> gold with chance melt
tests:
  - coins melt:
      given: |
        . c .
        c . c
      after: STEPS
      often: {coin -> gold: CHANCE}
"""


def problem(chance: str, melt: float = 0.02, steps: str = "1 step", text: str = PACK) -> str:
    rules = load_text(text.replace("CHANCE", chance).replace("STEPS", steps))
    (result,) = run_examples(rules.with_params({"coins.melt": melt}))
    return result.problem


@pytest.mark.parametrize(
    ("claim", "steps"),
    [("2%", "1 step"), ("1 - 0.98", "1 step"), ("1 - 0.98 * 0.98 * 0.98", "3 steps")],
)
def test_a_true_claim_holds(claim, steps):
    assert problem(claim, steps=steps) == ""


@pytest.mark.parametrize("melt", [0.2, 0.025, 0.015, 0.0, 1.0])
def test_another_chance_is_noticed(melt):
    assert "not 2 %" in problem("2%", melt)


@pytest.mark.parametrize(("claim", "melt"), [("0%", 0.001), ("100%", 0.999)])
def test_what_is_said_to_be_sure_must_be(claim, melt):
    assert problem(claim, float(claim.rstrip("%")) / 100) == ""
    assert problem(claim, melt)


def test_a_claim_about_nothing_fails():
    text = PACK.replace("coin -> gold: CHANCE", "gold -> coin: CHANCE")
    assert "no cell of the start world" in problem("2%", text=text)


@pytest.mark.parametrize("chance", tiered([0.001, 0.02, 0.3, 0.5, 0.9], [0.02, 0.5, 0.9]))
def test_the_error_rate_is_as_stated(chance):
    """The exact tails of the binomial distribution, for the true chance and for one that is off."""
    trials = trials_for(chance)
    off = OFF * min(chance, 1 - chance)
    assert tail_of_rejection(trials, chance, chance) < ERROR_RATE
    for other in (chance + off, chance - off):
        assert 1 - tail_of_rejection(trials, chance, other) < ERROR_RATE


def test_an_exception_in_a_thousand_is_noticed():
    for chance in (0, 1):
        assert (1 - RARE) ** trials_for(chance) <= ERROR_RATE


def tail_of_rejection(trials: int, claimed: float, true: float) -> float:
    """How likely a count that follows `true` is judged not to follow `claimed`."""
    inside = [hits for hits in range(trials + 1) if not is_unlikely(hits, trials, claimed)]
    low, high = min(inside), max(inside)
    logs = [
        math.lgamma(trials + 1) - math.lgamma(k + 1) - math.lgamma(trials - k + 1)
        + k * math.log(true) + (trials - k) * math.log(1 - true)
        for k in range(low, high + 1)
    ]  # fmt: skip
    return 1 - math.fsum(math.exp(one) for one in logs)


@pytest.mark.parametrize(
    ("before", "after", "code"),
    [
        ("{coin -> gold: CHANCE}", "{coin -> gold: 120%}", "PD403"),
        ("{coin -> gold: CHANCE}", "{coin -> gold: melt}", "PD405"),
        ("{coin -> gold: CHANCE}", "{coin -> silver: 2%}", "PD301"),
        ("{coin -> gold: CHANCE}", "{coin: 2%}", "PD201"),
        ("{coin -> gold: CHANCE}", '{"coin -> gold if floor": 2%}', "PD110"),
        ("{coin -> gold: CHANCE}", "2%", "PD107"),
    ],
)
def test_mistakes_are_explained(before, after, code):
    assert [found for found, _ in mistakes(PACK.replace("STEPS", "1 step").replace(before, after))] == [code]
