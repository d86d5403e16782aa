"""The table of mutants in docs/testing.md: no pack notices less than it says."""

from __future__ import annotations

import importlib.util
import json
import os
import sys
from functools import cache
from pathlib import Path
from types import ModuleType

import pytest

from powderdsl.testing.mutation.judging import COUNTED, by_hand_share, noticed_share

DOCS = Path(__file__).resolve().parents[2] / "docs"


@cache
def table() -> ModuleType:
    """docs/mutation_table.py, which is a script beside the pages and no module of a package."""
    spec = importlib.util.spec_from_file_location("mutation_table", DOCS / "mutation_table.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def measured() -> dict[str, dict[str, dict[str, dict[str, int]]]]:
    path = table().RESULTS
    return json.loads(path.read_text("utf-8")) if path.exists() else {}


def test_the_counts_add_up():
    for entry in measured().values():
        for counts in entry["packs"].values():
            assert set(counts) == set(COUNTED)
            assert counts["mutants"] == counts["equivalent"] + counts["killed"] + counts["survived"]
            assert counts["killed"] == sum(counts[key] for key in ("check", "invariant", "test", "generated"))
            assert 0 <= noticed_share(counts) <= 1
            assert 0 <= by_hand_share(counts) <= 1


def test_every_pack_is_in_the_table():
    assert {rules: list(entry["packs"]) for rules, entry in measured().items()} == {
        rules: table().packs_of(rules) for rules in table().compositions()
    }


def test_the_counts_of_a_pack_are_kept_when_others_are_counted_again():
    old, new = {"mutants": 3}, {"mutants": 4}
    measured = {"life": {"packs": {"life": old}}, "powderworld": {"packs": {"lava": old, "sand": old}}}
    after = table().record(measured, "powderworld", {"water": new, "lava": new})
    assert list(after) == ["life", "powderworld"]
    assert list(after["powderworld"]["packs"].items()) == [("sand", old), ("water", new), ("lava", new)]
    assert after["life"] == measured["life"]


def test_each_pack_is_told_as_soon_as_it_is_counted(monkeypatch):
    from powderdsl.testing.mutation import judging

    def judged(rules, packs, numbers, jobs, seed, worlds):
        for number in numbers:
            if number > 12:  # in the middle of gas
                raise KeyboardInterrupt
            yield number, judging.Verdict("killed", "test")

    monkeypatch.setattr(judging, "run_campaign", judged)
    found = table().count("powderworld", ["sand", "gas"], 1)
    assert next(found)["sand"]["killed"] == 10
    with pytest.raises(KeyboardInterrupt):
        next(found)


@pytest.mark.campaign
@pytest.mark.parametrize(
    "rules", [pytest.param(rules, id=rules.rpartition("/")[2]) for rules in table().compositions()]
)
def test_no_more_mutants_survive_than_the_table_says(rules, monkeypatch):
    monkeypatch.chdir(DOCS.parent)
    for found in table().count(rules, table().packs_of(rules), os.cpu_count() or 1):
        for pack, counts in found.items():
            said = measured().get(rules, {"packs": {}})["packs"].get(pack)
            if said is None:
                pytest.skip(f"{pack} of {rules} is not in the table: make mutation")
            assert counts["survived"] <= said["survived"]
