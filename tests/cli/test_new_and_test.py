"""`powderdsl new` and `powderdsl test`: packs and the tests that stand in them."""

from __future__ import annotations

import pytest

import powderdsl as package
from powderdsl.testing.pack_tests.runner import SEEDS, run_examples
from tests.cli.commands import PACK, powderdsl

TESTS = """\
tests:
  - two grains fall side by side:
      given: |
        . . . .
        . G G .
        . . . .
        # # # #
      after: 3 steps
      always: [grit or empty or wall]
      expect: |
        . . . .
        ? ? ? ?
        . x x .
        # # # #
      legend: {x: grit}
"""


def run_tests(text: str, folder, exits: int):
    (folder / "grit.yaml").write_text(PACK + text)
    return powderdsl("test", "core+grit.yaml", exits=exits)


# new


@pytest.mark.parametrize("name", ["salt", "Salt2", "x", "a_name_of_exactly_forty_characters_xxxxx"])
def test_a_new_pack_checks_runs_and_passes_its_test(folder, name):
    assert f"run {name}.yaml" in powderdsl("new", name, exits=0).stdout
    assert [path.name for path in folder.iterdir()] == [f"{name}.yaml"]
    rules = f"{name}.yaml"
    powderdsl("check", rules, exits=0)
    assert f"ok    {name}: " in powderdsl("test", rules, exits=0).stdout


def test_new_elements_have_free_ids_and_colors_of_their_own(folder):
    for name in ("salt", "pepper", "chalk"):
        powderdsl("new", name, exits=0)
    everything = package.load("powderworld", "salt.yaml", "pepper.yaml", "chalk.yaml")
    assert [element.name for element in everything.elements[-3:]] == ["salt", "pepper", "chalk"]
    assert len({element.color for element in everything.elements}) == len(everything.elements)


def test_new_writes_to_a_folder_also_beside_files_that_are_broken(folder):
    (folder / "packs").mkdir()
    (folder / "packs" / "broken.yaml").write_text("pack: [")
    (folder / "packs" / "other.yaml").write_bytes(b"\xff")
    powderdsl("new", "salt", "--dir", "packs", exits=0)
    assert (folder / "packs" / "salt.yaml").exists()


def test_new_never_overwrites(folder):
    (folder / "salt.yaml").write_text("precious")
    (folder / "link.yaml").symlink_to("nowhere")
    for name in ("salt", "link"):
        assert "exists already" in powderdsl("new", name, exits=2).stderr
    assert (folder / "salt.yaml").read_text() == "precious"


# test


def test_tests_that_pass(folder):
    run_tests("", folder, exits=0)
    result = run_tests(TESTS, folder, exits=0)
    assert "ok    grit: two grains fall side by side\n" in result.stdout
    assert result.stdout.endswith("all passed\n")


def test_what_rules_name_is_reported(folder):
    """Of other packs, the number of tests that pass, and what is wrong."""
    (folder / "grit.yaml").write_text(PACK + TESTS)
    for rules, own, counted in [
        ("core+water+grit.yaml", "grit", "grit.yaml: 1 of 1 rule fired"),
        ("water", "water", "rules/water.yaml: "),
    ]:
        lines = powderdsl("test", rules, "--examples", 0, exits=0).stdout.splitlines()
        passed = [line.split()[1] for line in lines if line.startswith("ok ")]
        assert {*passed} == {f"{own}:", "other"}
        assert passed[-1] == "other"
        assert not [line for line in lines if "core:" in line or "core.yaml" in line]
        assert [line for line in lines if line.startswith(counted) or f"/{counted}" in line]
    lines = powderdsl("test", "core+water", "--examples", 0, exits=0).stdout.splitlines()
    assert {"core:", "water:"} == {line.split()[1] for line in lines if line.startswith("ok ")}


def test_what_is_not_as_expected_is_shown(folder):
    result = run_tests(TESTS.replace(". x x .", ". x . ."), folder, exits=1)
    place = "grit.yaml:12: row 2, column 2 is `grit`, not `empty` (seed 0, after 3 steps)"
    assert f"FAIL  grit: two grains fall side by side\n      {place}\n" in result.stdout
    assert "      given      expected   found\n" in result.stdout
    assert "      . . . .    . x . .    . G G .\n" in result.stdout
    assert result.stdout.endswith("1 failed\n")


def test_a_condition_that_does_not_always_hold(folder):
    result = run_tests(TESTS.replace("grit or empty or wall", "empty or wall"), folder, exits=1)
    assert "`empty or wall` does not hold at row 2, column 1 (seed 0, after 1 step)" in result.stdout


def test_a_test_tries_five_seeds_or_its_own(folder):
    (folder / "grit.yaml").write_text(PACK + TESTS)
    (folder / "seeded.yaml").write_text(
        PACK.replace("grit", "seeded").replace("200", "201").replace("#123456", "#123457").replace("G", "S")
        + TESTS.replace("grit", "seeded").replace("G", "S")
        + "      seed: 7\n"
    )
    worlds = []
    results = run_examples(package.load("core", "grit.yaml", "seeded.yaml"), seen=worlds.append)
    seeds = {
        result.example.pack: tuple(world.seed.tolist()) for result, world in zip(results, worlds, strict=True)
    }
    assert seeds["grit"] == SEEDS
    assert seeds["seeded"] == (7,)


def test_a_test_that_passes_only_by_chance_fails(folder):
    lonely = """\
tests:
  - a lone grain is gone at once:
      given: G
      after: 1 step
      expect: .
"""
    run_tests(lonely, folder, exits=1)
    (outcome,) = [r for r in run_examples(package.load("core", "grit.yaml")) if r.example.pack == "grit"]
    assert not outcome.passed
    assert outcome.after == ("G",)
    certain = package.load("core", "grit.yaml", params={"grit.vanish": 1})
    assert all(result.passed for result in run_examples(certain) if result.example.pack == "grit")


def test_conditions_may_read_fields_draws_and_parameters(folder):
    conditions = (
        "always: [momentum in -10..10, interact > 0, count(wall) >= 0, vanish <= 50%, grit or not grit]"
    )
    run_tests(TESTS.replace("always: [grit or empty or wall]", conditions), folder, exits=0)


def test_rules_that_are_wrong_are_not_tested(folder):
    result = run_tests(TESTS.replace("G G", "G Z"), folder, exits=2)
    assert "PD301" in result.stderr
    assert "^" in result.stderr
