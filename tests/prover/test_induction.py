"""Claims by induction: what is proven holds in random worlds, and what is false is not proven."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import pytest

from powderdsl.compiler import load
from powderdsl.model.text import one_line
from powderdsl.model.types import Ruleset
from powderdsl.prover.induction import Prover
from powderdsl.prover.solver import OutOfWork, Solver
from powderdsl.prover.symbolic import Budget, Formulas, Undecided, deep_recursion
from tests.semantics.texts import load_text

SMALL = (
    "brians_brain",
    "cyclic",
    "forest_fire",
    "langtons_ant",
    "life",
    "margolus",
    "wireworld",
    "core+sand+water",
)


def verdicts(ruleset: Ruleset) -> dict[str, str]:
    """Each claim of a ruleset with what may break it: a pass, or nothing if it is proven."""
    broken = {}
    with deep_recursion():
        prover = Prover(ruleset, Budget.of(60))
        assert prover.well_formed() is None
        for invariant in ruleset.invariants:
            transition = prover.broken(invariant.claim, invariant.without)
            broken[one_line(invariant.span)] = transition.name if transition else ""
    return broken


@pytest.mark.parametrize("rules", SMALL)
def test_every_claim_of_small_rulesets_is_proven(rules: str) -> None:
    results = verdicts(load(rules))
    assert results
    assert not any(results.values())


PACK = """
pack: claims
elements:
  ground: {id: 0, color: "#000000"}
  stone: {id: 1, color: "#808080"}
  ash: {id: 2, color: "#606060"}
  ember: {id: 3, color: "#F08000"}
fields:
  heat: {type: 0..7, at: element}
streams: [luck]
passes:
  fall:
    do: swap below if stone and below is ground
  burn:
    do:
      - ember -> ash if luck < 50%
      - ash -> ember if above is ember and luck < 10%
      - heat := min(heat + 1, 5) where ember
invariants:
"""


@pytest.mark.parametrize(
    ("claim", "breaks"),
    [
        ("count(stone) is constant", ""),
        ("count(ground, stone) is constant", ""),
        ("count(ember, ash) is constant", ""),
        ("count(ember) never rises", "burn"),
        ("count(ash) never falls", "burn"),
        ("count(ember) never rises without ember", ""),
        ("count(ash) is constant without ember", ""),
        ("heat stays in 0..5", ""),
        ("heat stays in 0..4", "burn"),
        ("never (stone and heat > 5)", ""),
        ("never (stone and below is ground)", ""),
        ("never (stone and below is stone)", "fall"),
        ("never (ember and above is ember and below is ember)", "burn"),
        ("stone never changes", "fall"),
        ("mirrored worlds agree", ""),
        ("rotated worlds agree", "fall"),
        ("nothing reaches beyond 2 cells", ""),
    ],
)
def test_claims_are_proven_if_they_are_true(claim: str, breaks: str) -> None:
    ruleset = load_text(f"{PACK}  - {claim}\n")
    (found,) = verdicts(ruleset).values()
    assert found.partition(".")[0] == breaks


def test_a_reach_that_is_too_short_is_not_decided() -> None:
    with pytest.raises(Undecided):
        verdicts(load_text(f"{PACK}  - nothing reaches beyond 0 cells\n"))


CLOCK = """
pack: clock
elements:
  dark: {id: 0, color: "#000000"}
  light: {id: 1, color: "#FFFFFF"}
fields:
  heading: {type: direction, default: right, at: place, resets: step}
streams: [luck]
passes:
  blink:
    do:
      - light -> dark if luck < 50%
      - dark -> light if luck < 50%
  turn:
    do: light -> dark if heading is right and right is light
invariants:
"""


@pytest.mark.parametrize(
    ("claim", "is_proven"),
    [
        ("never (light and step mod 2 == 1)", False),  # it may be light at an even step
        ("never light for 3 steps", False),  # each step draws anew
        ("mirrored worlds agree", False),  # what is reset does not turn
    ],
)
def test_what_changes_from_step_to_step_is_not_taken_for_the_same(claim: str, is_proven: bool) -> None:
    try:
        (transition,) = verdicts(load_text(f"{CLOCK}  - {claim}\n")).values()
    except Undecided:
        transition = "undecided"
    assert (transition == "") == is_proven


GUST = """
pack: gusts
elements: {air: {id: 0, color: "#000000"}}
fields:
  gust: {type: vec2(-2..2), at: element, default: "vector(1, -2)"}
passes:
  calm:
    do: air -> air
invariants:
"""


@pytest.mark.parametrize("turn", ["mirrored", "rotated"])
def test_vectors_of_fresh_cells_are_not_taken_to_turn(turn: str) -> None:
    with pytest.raises(Undecided):
        verdicts(load_text(f"{GUST}  - {turn} worlds agree\n"))


LOAD = """
pack: loads
elements:
  sand: {id: 0, color: "#C0A060"}
  acid: {id: 1, color: "#80F060"}
  crate: {id: 2, color: "#604020"}
fields:
  load: {type: element, at: element, of: crate, default: acid}
passes:
  spill:
    do: sand -> acid if load is acid
invariants:
"""


def test_usual_elements_of_fields_are_there_though_worlds_start_without_them() -> None:
    (broken,) = verdicts(load_text(f"{LOAD}  - count(acid) never rises without acid\n")).values()
    assert broken == "spill"


CUT = """
pack: cuts
elements:
  air: {id: 0, color: "#000000"}
  seed: {id: 1, color: "#808080"}
  husk: {id: 2, color: "#606060"}
fields:
  wet: {type: flag, at: element}
  heat: {type: real(0..5), at: place}
  age: {type: 0..3, at: place, default: 0, resets: step}
passes:
  drift:
    repeat 2:
      let: {rests: wet}
      for side in (right, left):
        - seed moves side leaving air if not rests and side is air, then side.wet := yes
  tick:
    do:
      - do: age := age + 1 where luck < 50%
      - do: age := age + 1 where luck < 50%
      - do: seed -> husk if age == 2
  cool:
    do: wet := no where husk
    then: heat := heat * 0.5 where heat * 0.5 > 0
  tidy:
    do: wet := yes where husk
    then: wet := no where husk
streams: [luck]
invariants:
"""


@pytest.mark.parametrize(
    ("claim", "breaks"),
    [
        ("count(seed, husk) is constant", ""),  # what moved `rests` before does not move seeds
        ("count(seed) is constant", "tick"),  # `age` is not what it was before the pass
        ("never not heat > 0", "cool"),  # tiny floats become zero at the end of a pass
        ("never (husk and wet)", ""),  # in the middle of a pass it is broken
    ],
)
def test_passes_are_cut_where_that_is_sound(claim: str, breaks: str) -> None:
    (found,) = verdicts(load_text(f"{CUT}  - {claim}\n")).values()
    assert found.partition(".")[0] == breaks


def test_no_formula_is_made_once_the_budget_is_spent(monkeypatch: pytest.MonkeyPatch) -> None:
    ruleset = load_text(f"{PACK}  - mirrored worlds agree\n")
    with deep_recursion():
        prover = Prover(ruleset, Budget(-1))
        monkeypatch.setattr(Formulas, "value", pytest.fail)
        with pytest.raises(OutOfWork):
            prover.broken(ruleset.invariants[0].claim)


@pytest.mark.parametrize("rules", SMALL)
def test_formulas_of_proofs_against_python_sat(rules: str, monkeypatch: pytest.MonkeyPatch) -> None:
    solvers = pytest.importorskip("pysat.solvers", reason="python-sat is not installed")
    answers = []

    class Compared(Solver):
        """A solver that gives all its clauses and questions to python-sat too."""

        def __init__(self) -> None:
            super().__init__()
            self.other = solvers.Cadical153()

        def add_clause(self, literals: Iterable[int]) -> None:
            clause = list(literals)
            self.other.add_clause(clause)
            super().add_clause(clause)

        def solve(self, assumptions: Sequence[int] = (), **options: Any) -> bool:
            answer = super().solve(assumptions, **options)
            assert answer == self.other.solve(assumptions=list(assumptions))
            answers.append(answer)
            return answer

    monkeypatch.setattr("powderdsl.prover.questions.Solver", Compared)
    verdicts(load(rules))
    assert answers
