"""`params` of tests in packs: values of parameters in one test alone."""

from __future__ import annotations

import pytest

import powderdsl
from powderdsl.simulation.simulator import compile
from powderdsl.testing.pack_tests.runner import run_examples
from tests.compilers import skip_without_compiler
from tests.semantics.texts import diagnosed, load_text

PACK = """\
pack: coins
params:
  melt: 0%
  least: {type: 0..9, default: 9}
elements:
  floor: {id: 0, color: "#101010", glyph: "."}
  coin: {id: 1, color: "#202020", glyph: c}
  gold: {id: 2, color: "#303030", glyph: g}
passes:
  melt:
    do: coin -> gold if count(coin) < least with chance melt
tests:
  - coins stay:
      given: c c c
      expect: c c c
"""


def problems(test: str, backend: str = "reference") -> list[str]:
    skip_without_compiler(backend)
    rules = load_text(f"{PACK}  - more:\n      given: c c c\n{test}")
    return [result.problem for result in run_examples(rules, sim=compile(rules, backend, tensors=False))]


@pytest.mark.parametrize("backend", ["reference", "wasm", "torch", "native"])
@pytest.mark.parametrize("claim", ["expect: g g g", "often: {coin -> gold: 100%}"])
def test_a_test_sets_parameters_for_itself_alone(backend, claim):
    assert problems(f"      params: {{melt: 100%}}\n      {claim}\n", backend) == ["", ""]
    assert all(problems(f"      {claim}\n", backend)[1:])


def test_conditions_read_the_values_of_their_test():
    params = "      params: {coins.melt: 50%, least: 1 + 1}\n"
    assert problems(f"{params}      always: [least == 2]\n      often: {{coin -> gold: 0%}}\n") == ["", ""]
    wrong = problems(f"{params}      always: [least == 3]\n")
    assert wrong == ["", "`least == 3` does not hold at row 0, column 0"]


def test_a_test_of_a_parameter_that_may_be_absent_waits_for_its_pack(folder):
    test = "tests:\n  - air stays:\n      given: .\n      params: {water.melt?: 100%}\n      expect: .\n"
    (folder / "guest.yaml").write_text(f"pack: guest\nneeds: core\n{test}")
    alone, beside = (powderdsl.load(*packs, "guest.yaml") for packs in (["core"], ["core", "water"]))
    assert [one.name for one in alone.tests if one.pack == "guest"] == []
    (example,) = (one for one in beside.tests if one.pack == "guest")
    assert example.params == (("water.melt", 1.0),)
    assert example.scope == ("core", "water", "guest")


def test_an_unknown_parameter_names_the_closest():
    (wrong,) = diagnosed(
        f"{PACK}  - more:\n      given: c\n      params: {{coins.mlt: 1%}}\n      expect: c\n"
    )
    assert wrong.code == "PD309"
    assert wrong.helps[0] == "did you mean `coins.melt`?"
