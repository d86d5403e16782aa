"""`powderdsl test --mutate`: mistakes in packs, what notices them, and tests for those that nothing notices."""

from __future__ import annotations

import json

import pytest

import powderdsl as package
from powderdsl.testing.mutation.judging import Original, sampled
from tests.cli.commands import powderdsl

PACK = """\
pack: spread  # where it goes
elements:
  dry: {id: 0, color: "#101010", glyph: "."}
  wet: {id: 1, color: "#202020", glyph: w}
passes:
  spread:
    do: dry -> wet if left is wet  # to the right
tests:
  # the only one
  - two dry cells stay dry:
      given: . .
      after: 2 steps
      expect: . .

# the end
"""


@pytest.fixture
def folder(folder):
    (folder / "spread.yaml").write_text(PACK)
    return folder


def mutate(*arguments, **options):
    return powderdsl("test", "--mutate", "--jobs", "1", *arguments, **options)


def test_written_tests_pass_and_notice_what_survived_before(folder):
    listed = mutate("spread.yaml", exits=1).stdout
    assert "survived  spread.yaml:7:23: neighbor" in listed
    assert "- generated " in listed
    before = json.loads(mutate("spread.yaml", "--json").stdout)["spread.yaml"]
    assert before["survived"] > 0
    mutate("spread.yaml", "--write")
    text = (folder / "spread.yaml").read_text()
    assert text.startswith(PACK.partition("\n# the end")[0])
    assert text.endswith("# the end\n")
    rules = package.load("spread.yaml")
    assert len(rules.tests) > 1
    powderdsl("test", "spread.yaml", "--no-keep", "--examples", "10", exits=0)
    after = json.loads(mutate("spread.yaml", "--json").stdout)["spread.yaml"]
    assert after["mutants"] == before["mutants"]
    assert after["survived"] == 0
    assert after["generated"] >= before["survived"]


def test_a_sample_is_in_proportion_and_the_same_again():
    mutants = Original.of("life").mutants()
    some = sampled(mutants, 20, 3)
    assert some == sampled(mutants, 20, 3) != sampled(mutants, 20, 4)
    assert len(set(some)) == 20
    assert len({mutants[number].operator for number in some}) >= 6


def test_mutants_run_with_other_parameters(folder):
    text = PACK.replace("passes:", "params: {speed: 50%}\npasses:").replace(
        "is wet  #", "is wet with chance speed  #"
    )
    sure = "  - it spreads for sure:\n      given: w .\n      after: 1 step\n      expect: w w\n"
    (folder / "spread.yaml").write_text(text.replace("# the end", sure))
    usual = json.loads(mutate("spread.yaml", "--json").stdout)["spread.yaml"]
    set_ = json.loads(mutate("spread.yaml", "--json", "--set", "spread.speed=100%").stdout)["spread.yaml"]
    assert set_["test"] > usual["test"], "by chance, the second test fails without any mistake"
    assert "PD309" in mutate("spread.yaml", "--set", "spread.nothing=1", exits=2).stderr
