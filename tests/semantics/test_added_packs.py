"""Packs that are added to a ruleset: what they change in others' invariants and tests is told and never fails."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import powderdsl as library
from powderdsl.diagnostics import Severity
from powderdsl.model.text import one_line, place_of
from powderdsl.testing.generators.cases import Start
from powderdsl.testing.pack_tests.runner import run_examples
from powderdsl.testing.properties.outcomes import Result
from powderdsl.testing.properties.running import Runner
from powderdsl.testing.properties.search import InvariantSearch, SearchPlan, quick_results, refuted
from tests.cli.commands import ROOT, powderdsl


@dataclass(frozen=True)
class Added:
    """A pack that somebody adds to `powderworld`, and what that changes: invariants, each with the line that does it."""

    name: str
    text: str
    changes: tuple[tuple[str, int], ...]


ADDED = (
    Added(
        "moss",
        """pack: moss
needs: [core, water, stone]
elements:
  moss: {id: 120, density: 5, color: "#6A994E", tags: fuel?}
passes:
  creep:
    after: flow
    do: stone -> moss if count(water) > 0 and above is not stone with chance 30%
""",
        (
            ("count(lava?, stone?) is constant without (acid?, cloner?)", 8),
            ("count(stone?) never falls without acid?", 8),
        ),
    ),
    Added(
        "bane",
        """pack: bane
needs: core
elements:
  bane: {id: 121, density: 3, gravity: yes, color: "#B7E4C7", glyph: "!", tags: fluid}
passes:
  corrode:
    after: flow
    do:
      - any but (empty, bane) -> empty if above is bane with chance 40%
      - bane -> empty if below is not (empty, bane) with chance 20%
""",
        (("wall never changes", 9), ("count(cloner) is constant without (mole?, snake?)", 9)),
    ),
    Added(
        "quake",
        """pack: quake
needs: core
params: {quakes: 10%}
passes:
  quake:
    before: gravity
    do: sand? swaps above if above is (wall, wood?) with chance quakes
""",
        (("wall never changes", 7),),
    ),
    Added(
        "tinder",
        """pack: tinder
about: Walls burn.
needs: core
also:
  wall: {tags: fuel?, burns?: 20%}
""",
        (("wall never changes", 5),),
    ),
)


pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("folder")]


def write(name: str, text: str) -> str:
    Path(f"{name}.yaml").write_text(text, encoding="utf-8")
    return f"{name}.yaml"


def changes_of(rules: str) -> dict[str, str]:
    """What `powderdsl check` tells of added packs: invariants, and where the reason stands. Nothing may be worse."""
    ruleset = library.load(rules)
    found = refuted(ruleset, quick_results(ruleset))
    assert {one.code for one in found} <= {"PD515"}
    assert all(one.severity is Severity.NOTE for one in found)
    return {one.message.split("`")[-2]: one.message.rpartition(": ")[2] for one in found}


@pytest.mark.parametrize("added", ADDED, ids=lambda added: added.name)
def test_a_pack_that_changes_others_is_told_by_its_own_line(added: Added) -> None:
    found = changes_of(f"powderworld+{write(added.name, added.text)}")
    for invariant, line in added.changes:
        assert found[invariant] == f"{added.name}.yaml:{line}"


STEAM = ROOT / "docs/examples/steam.yaml"


def test_check_of_an_added_pack_ends_well_and_says_what_changes() -> None:
    result = powderdsl("check", f"powderworld+{STEAM}", "--warnings-as-errors", exits=0)
    claim = "count(water?, ice?) is constant without (acid?, cloner?, plant?)"
    assert f"  with `steam`, `{claim}` no longer holds: {STEAM}:17\n" in result.stdout
    assert "powderworld+steam: 15 elements, 13 passes, no errors, 2 notes" in result.stdout
    data = json.loads(powderdsl("check", "--json", f"powderworld+{STEAM}").stdout)
    assert [one["code"] for one in data] == ["PD515", "PD515"]


def test_what_the_scope_breaks_alone_stays_an_error() -> None:
    shutil.copytree(ROOT / "rules", "rules")
    acid = Path("rules/acid.yaml")
    acid.write_text(acid.read_text("utf-8").replace("(acid_proof, acid)", "(acid, empty)"), encoding="utf-8")
    moss = write("moss", ADDED[0].text)
    ruleset = library.load(f"rules/powderworld.yaml+{moss}")
    found = {one.code: one for one in refuted(ruleset, quick_results(ruleset))}
    assert set(found) == {"PD512", "PD515"}
    assert found["PD512"].primary.span is not None
    assert found["PD512"].primary.span.text == "wall never changes"


def test_a_packs_own_claims_are_errors_only_where_it_breaks_them_itself() -> None:
    text = ADDED[1].text + "invariants:\n  - count(bane) is constant\n"
    ruleset = library.load(f"powderworld+{write('bane', text)}")
    errors = [one for one in refuted(ruleset, quick_results(ruleset)) if one.severity is Severity.ERROR]
    assert [one.primary.span.text for one in errors if one.primary.span] == ["count(bane) is constant"]
    pole = "elements: {pole: {id: 125, density: 5, color: '#112233'}}\npasses:"
    text = ADDED[2].text.replace("passes:", pole) + "invariants: [pole never changes]\n"
    changes = changes_of(f"powderworld+{write('quake', text)}")
    assert changes["pole never changes"].startswith(str(ROOT / "rules/acid.yaml"))


def test_of_two_added_packs_the_one_that_matters_is_named() -> None:
    moss, quake = write("moss", ADDED[0].text), write("quake", ADDED[2].text)
    ruleset = library.load(f"powderworld+{moss}+{quake}")
    names = ("wall", "sand", "wall", "stone", "water", "wall")
    results = tried(ruleset, [[one.id] for name in names if (one := ruleset.element(name))])
    packs = {one.prop.text: one.difference.packs for one in results if one.difference}
    assert packs["wall never changes"] == ("quake",)
    assert packs["count(stone?) never falls without acid?"] == ("moss",)
    assert {one.status for one in results if one.counterexample} == {"differs"}
    assert all(one.holds for one in results)


def tried(ruleset: library.Ruleset, cells: list[list[int]]) -> list[Result]:
    """What comes of a world of these elements with many seeds."""
    texts = [one_line(invariant.span) for invariant in ruleset.invariants]
    search = InvariantSearch.of(Runner(ruleset, "reference"), SearchPlan(0), texts)
    search.try_sample(replace(Start.fresh(cells).repeated(512), seed=np.arange(512)), 3)
    return search.finish()


def test_a_world_never_starts_with_what_the_claim_excludes() -> None:
    """Steam turns to water in the first step, and the plant grows in the second: both have to be shown."""
    ruleset = library.load(f"powderworld+{STEAM}")
    wall, steam, plant, water = (
        one.id for name in ("wall", "steam", "plant", "water") if (one := ruleset.element(name))
    )
    results = tried(ruleset, [[wall, wall], [wall, steam], [wall, plant]])
    (result,) = (one for one in results if one.prop.text.startswith("count(plant?) never rises"))
    found = result.counterexample
    assert found is not None
    assert found.steps > 1
    assert not (found.before["element"] == water).any()
    assert result.difference is not None
    lines = [place_of(cause.span).rpartition("/")[2] for cause in result.difference.causes]
    assert set(lines) <= {"steam.yaml:18", "steam.yaml:19"}
    assert lines


def test_tests_that_an_added_pack_changes_are_told_and_do_not_fail() -> None:
    rules = f"core+sand+water+fire+wind+{write('quake', ADDED[2].text.replace('10%', '90%'))}"
    results = {one.example.name: one for one in run_examples(library.load(rules))}
    changed = results["an explosion throws sand away"]
    assert (changed.passed, changed.failed, changed.added) == (False, False, ("quake",))
    rules = "core+sand+fire+wind+quake.yaml"
    result = powderdsl("test", rules, "--examples", "64", "--no-keep", exits=0)
    told = "differs  wind: an explosion throws sand away\n      with `quake`\n      quake.yaml:7: sand? swaps"
    assert told in result.output
    assert "differs   core: wall never changes (with `quake`: quake.yaml:7)" in result.output
    assert "different with added packs" in result.output.splitlines()[-1]
    data = json.loads(powderdsl("test", rules, "--examples", "64", "--no-keep", "--json").stdout)[rules]
    assert next(one for one in data["tests"] if one["test"] == changed.example.name)["added"] == ["quake"]
    (wall,) = (one for one in data["properties"] if one["property"] == "wall never changes")
    assert (wall["status"], wall["difference"]["packs"]) == ("differs", ["quake"])


def test_a_test_that_fails_in_its_scope_fails_with_more_packs_too() -> None:
    text = ADDED[0].text + "tests:\n  - nothing grows:\n      given: |\n        # # #\n        # o ~\n"
    text += "      after: 30 steps\n      expect: |\n        # # #\n        # o ?\n"
    rules = f"core+water+stone+sand+{write('moss', text)}"
    result = powderdsl("test", rules, "--examples", "0", "--no-keep", exits=1)
    assert "FAIL  moss: nothing grows" in result.output
