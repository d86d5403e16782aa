"""What notices a mutant, in one process or several; the table in docs/testing.md says no less than is noticed."""

from __future__ import annotations

import json
import os
import runpy
from multiprocessing import active_children
from pathlib import Path
from types import SimpleNamespace

import pytest

from powderdsl.simulation.simulator import compile
from powderdsl.testing.mutation.judging import (
    COUNTED,
    Original,
    Verdict,
    broken_invariant,
    judge,
    noticed_share,
    run_campaign,
)
from tests.semantics.texts import load_text

DOCS = Path(__file__).resolve().parents[2] / "docs"


TABLE = SimpleNamespace(**runpy.run_path(str(DOCS / "mutation_table.py")))


def measured() -> dict[str, dict[str, dict[str, dict[str, int]]]]:
    path = TABLE.RESULTS
    return json.loads(path.read_text("utf-8")) if path.exists() else {}


def test_every_pack_is_in_the_table_and_the_counts_add_up():
    assert list(measured()) == list(TABLE.compositions())
    for rules, entry in measured().items():
        assert list(entry["packs"]) == TABLE.packs_of(rules)
        survivors = entry.get("survivors", {})
        for pack, counts in entry["packs"].items():
            assert len(survivors.get(pack, ())) in (counts["survived"], 0)
            assert set(counts) == set(COUNTED)
            assert counts["mutants"] == counts["equivalent"] + counts["killed"] + counts["survived"]
            assert counts["killed"] == sum(counts[key] for key in ("check", "invariant", "test", "generated"))
            assert 0 <= noticed_share(counts) <= 1


@pytest.mark.slow
@pytest.mark.parametrize("rules", TABLE.compositions(), ids=lambda rules: rules.rpartition("/")[2])
def test_no_more_mutants_survive_than_the_table_says(rules, monkeypatch):
    monkeypatch.chdir(DOCS.parent)
    for found, _ in TABLE.count(rules, TABLE.packs_of(rules), os.cpu_count() or 1):
        for pack, counts in found.items():
            said = measured().get(rules, {"packs": {}})["packs"].get(pack)
            if said is None:
                pytest.skip(f"{pack} of {rules} is not in the table: make mutation")
            assert counts["survived"] <= said["survived"]


ROCK = """\
pack: rocks
elements:
  soil: {id: 0, color: "#101010"}
  rock: {id: 1, color: "#202020", weight: 3, tags: hard}
  seed: {id: 2, color: "#303030"}
tags: {hard: stays whole}
properties: {weight: 0..7}
passes:
  harden:
    do: soil -> rock if left is seed
invariants:
  - never (rock and weight < 2)
  - never (rock and not hard)
"""


@pytest.mark.parametrize(
    ("right", "wrong", "claim"),
    [
        ("weight: 3", "weight: 1", "never (rock and weight < 2)"),
        (", tags: hard", "", "never (rock and not hard)"),
    ],
)
def test_invariants_about_properties_and_tags_are_asked_where_no_world_differs(tmp_path, right, wrong, claim):
    path = tmp_path / "rocks.yaml"
    path.write_text(ROCK)
    mutant = load_text(ROCK.replace(right, wrong))
    broken = broken_invariant(Original.of(str(path)), compile(mutant, backend="wasm"))
    assert broken.span.text == claim


def test_survivors_alone_are_judged_again(tmp_path, monkeypatch):
    path = tmp_path / "clock.yaml"
    path.write_text("""\
pack: clock
elements: {tick: {id: 0, color: "#000000"}}
fields: {age: {type: 0..9, at: place}}
passes:
  grow:
    do: age := min(age + 1, 5)
""")
    killed = {0}

    def campaign(rules, packs, numbers, jobs, seed):
        for n in numbers:
            yield n, Verdict("killed", "test") if n in killed else Verdict("survived")

    monkeypatch.setattr("powderdsl.testing.mutation.judging.run_campaign", campaign)
    ((counts, survivors),) = TABLE.count(str(path), ["clock"], 1)
    assert counts["clock"]["survived"] == len(survivors["clock"]) == counts["clock"]["mutants"] - 1
    killed |= {2, 3}
    ((again, rest),) = TABLE.count(str(path), ["clock"], 1, survivors)
    assert again["clock"]["mutants"] == counts["clock"]["survived"]
    ((whole, alive),) = TABLE.count(str(path), ["clock"], 1)
    assert TABLE.judged_again(counts, again) == whole
    assert rest == alive
    path.write_text("# a line before\n" + path.read_text())
    with pytest.raises(ValueError, match="have changed"):
        next(TABLE.count(str(path), ["clock"], 1, alive))


def test_a_mutant_with_another_default_is_another_program(tmp_path):
    path = tmp_path / "clock.yaml"
    path.write_text("""\
pack: clock
params: {most: {type: 0..9, default: 5}}
elements: {tick: {id: 0, color: "#000000"}}
fields: {age: {type: 0..9, at: place}}
passes:
  grow:
    do: age := min(age + 1, most)
""")
    original = Original.of(str(path))
    (larger, smaller) = (m for m in original.mutants() if m.operator == "constant" and "default" in m.diff)
    assert [judge(original, mutant).status for mutant in (larger, smaller)] == ["survived", "survived"]


def test_a_pack_is_in_the_table_once():
    packs = [pack for rules in TABLE.compositions() for pack in TABLE.packs_of(rules)]
    assert len(packs) == len(set(packs))


def test_tests_run_with_what_a_pack_needs_then_with_what_its_tests_name():
    world = Original.of("powderworld2")
    small, larger = ({pack.name.text for pack in part.packs} for part in world.parts("climbing"))
    assert small == {"core2", "water", "plant", "climbing"}
    assert small < larger < {pack.name.text for pack in world.packs}
    (mutant, *_) = (m for m in world.mutants(frozenset({"climbing"})) if m.operator == "chance")
    verdict = judge(world, mutant)
    assert verdict.by == "test"
    assert "sim" not in vars(world), "the whole has not been compiled"


@pytest.mark.slow
def test_several_processes_change_no_outcome():
    numbers = [0, 7, 14, 21, 28]
    alone = dict(run_campaign("wireworld", (), numbers, jobs=1, seed=0))
    together = dict(run_campaign("wireworld", (), numbers, jobs=2, seed=0))
    assert together == alone
    assert {verdict.status for verdict in alone.values()} - {"survived"}


@pytest.mark.slow
def test_a_process_that_is_killed_is_an_error():
    campaign = run_campaign("wireworld", (), list(range(40)), jobs=2, seed=0)
    next(campaign)
    for process in active_children():
        process.kill()
    with pytest.raises(OSError, match="was killed"):
        list(campaign)
    assert active_children() == []
