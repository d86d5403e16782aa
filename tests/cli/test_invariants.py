"""`powderdsl test` with invariants: proven, tested, broken, made small, kept, replayed; and packs under pytest."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cli.commands import powderdsl

PACK = """pack: yard
elements:
  soil: {id: 0, color: "#806040", glyph: "."}
  weed: {id: 1, color: "#30A030", glyph: w}
  rock: {id: 2, color: "#808080", glyph: "#"}
fields:
  age: {type: 0..9, at: place}
passes:
  grow:
    do:
      - soil -> weed if right is weed
      - rock -> soil if count(weed) > 2
      - age += 1 where weed
invariants:
  - count(weed) never falls
  - rock never changes
  - age stays in 0..5
  - never (rock and weed)
  - mirrored worlds agree
  - nothing reaches beyond 1 cell
tests:
  - weed grows to the left:
      given: . . w
      after: 1 step
      expect: . w w
"""


@pytest.fixture
def folder(folder, monkeypatch):
    monkeypatch.delenv("CI", raising=False)
    (folder / "yard.yaml").write_text(PACK)
    return folder


def test_invariants_are_proven_or_broken_by_small_worlds(folder):
    (found,) = json.loads(powderdsl("test", "yard.yaml", "--json", exits=1).stdout).values()
    status = {one["property"]: one["status"] for one in found["properties"] if one["pack"] == "yard"}
    assert status == {
        "count(weed) never falls": "proven",
        "rock never changes": "broken",
        "age stays in 0..5": "broken",
        "never (rock and weed)": "proven",
        "mirrored worlds agree": "broken",
        "nothing reaches beyond 1 cell": "proven",
    }
    assert all(one["status"] == "tested" for one in found["properties"] if one["pack"] == "automatic")
    (rock,) = [one for one in found["properties"] if one["property"] == "rock never changes"]
    world = rock["counterexample"]
    before = world["before"]
    assert len(before) * len(before[0]) <= 6
    assert before[world["row"]][world["column"]] == 2
    assert world["after"][world["row"]][world["column"]] == 0
    assert (world["steps"], world["clock"]) == (1, 0)
    assert [rule["place"] for rule in world["rules"]] == ["yard.yaml:12"]
    assert rock["place"] == "yard.yaml:16"
    assert found["rules"] == {"all": 3, "never": []}


def test_what_is_broken_is_drawn_kept_and_tried_again(folder):
    result = powderdsl("test", "yard.yaml", "--picture", "rock.png", exits=1)
    assert "by yard.yaml:12: rock -> soil if count(weed) > 2" in result.stdout
    assert "before" in result.stdout
    assert result.stdout.endswith("1 test, 6 invariants, 3 broken\n")
    assert (folder / "rock.png").stat().st_size > 100
    (kept,) = folder.glob(".powderdsl/*rock-never-changes*.yaml")
    assert f"--replay .powderdsl/{kept.name}" in kept.read_text()
    replayed = powderdsl("test", "yard.yaml", "--replay", str(kept), exits=1)
    assert "BROKEN    yard: rock never changes" in replayed.stdout
    (folder / "yard.yaml").write_text(PACK.replace("count(weed) > 2", "count(weed) > 8"))
    powderdsl("test", "yard.yaml", "--replay", str(kept), exits=0)


def test_nothing_is_kept_where_tests_are_thrown_away(folder, monkeypatch):
    monkeypatch.setenv("CI", "true")
    powderdsl("test", "yard.yaml", "--examples", "64", exits=1)
    assert not (folder / ".powderdsl").exists()


def test_the_same_seed_finds_the_same(folder):
    first, second = (powderdsl("test", "yard.yaml", "--json", "--no-keep") for _ in range(2))
    assert first.stdout == second.stdout


def test_packs_under_pytest(folder):
    (folder / "other.yaml").write_text("services: {web: 1}\n")
    root = Path(__file__).resolve().parents[2]
    command = [sys.executable, "-m", "pytest", "-p", "no:powderdsl", "-p", "powderdsl.testing.pytest_plugin"]
    command += ["-p", "no:xdist", "-p", "no:cacheprovider", "-v", "--rootdir", str(folder), str(folder)]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=300, check=False)
    assert "collected 7 items" in done.stdout, done.stdout + done.stderr
    assert "3 failed, 4 passed" in done.stdout
    assert "yard.yaml::weed grows to the left PASSED" in done.stdout
    assert "yard.yaml:16: broken at row" in done.stdout


@pytest.mark.parametrize(
    "packs",
    ["packs: [core, yard]", "packs: [core,\n  yard]", "packs:\n- core  # first\n- yard", "packs:\n  - yard"],
)
def test_a_pack_is_tested_in_the_ruleset_that_lists_it(tmp_path, packs):
    from powderdsl.testing.pytest_plugin import home_of

    (tmp_path / "yard.yaml").write_text(PACK)
    assert home_of(tmp_path / "yard.yaml") == str(tmp_path / "yard.yaml")
    (tmp_path / "field.yaml").write_text(f"ruleset: field\n{packs}\nabout: no shed\n")
    assert home_of(tmp_path / "yard.yaml") == str(tmp_path / "field.yaml")
    assert home_of(tmp_path / "shed.yaml") == str(tmp_path / "shed.yaml")
