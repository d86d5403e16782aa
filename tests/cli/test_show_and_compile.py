"""`powderdsl show` and `powderdsl compile`: rules as tables and as text."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path

import pytest

import powderdsl as package
from powderdsl.analysis.changes import moved_ids, reactions, unchanging_ids
from powderdsl.model.text import print_model, show_number, show_set
from tests.cli.commands import PACK, ROOT, powderdsl
from tests.semantics.test_differential import compositions

RULESETS = ("powderworld", "life", "wireworld", "margolus", "forest_fire", "langtons_ant")


@pytest.fixture(autouse=True)
def _repository(monkeypatch):
    """Places in shipped files are printed as seen from the repository."""
    monkeypatch.chdir(ROOT)


# show


def test_show_lists_elements_reactions_passes_and_parameters():
    lines = powderdsl("show", "powderworld", "--set", "fire.spread=12.5%").stdout.splitlines()
    tables = [line for line in lines if line and not line.startswith(" ")]
    titles = [line.split()[0] for line in tables[3:]]
    assert titles == ["Elements", "Fields", "Reactions", "Passes,", "Parameters"]
    rules = package.load("powderworld")
    for element in rules.elements:
        row = next(line for line in lines if line.split()[:2] == [str(element.id), element.name])
        assert element.color in row
        assert element.pack in row
    melting = next(line for line in lines if line.split()[:3] == ["ice", "water", "melt"])
    assert "ice -> water if count(thaws) > 1 and interact < melt" in melting
    assert "rules/water.yaml:" in melting
    assert sum("substeps" in line for line in lines) == 1
    assert any(line.split()[:3] == ["water.melt", "2%", "chance"] for line in lines)
    assert any(line.split()[:2] == ["fire.spread", "12.5%"] for line in lines)
    few = powderdsl("show", "core").stdout.splitlines()
    assert few[few.index("Reactions") + 1] == "  none"


def test_show_says_what_a_step_of_a_task_runs(tmp_path):
    pytest.importorskip("torch")
    assert "step: one call of native code" in powderdsl("show", "sand-pushing", "--cost", exits=0).stdout
    text = (ROOT / "tasks" / "keep-ice.yaml").read_text("utf-8")
    (tmp_path / "ice.yaml").write_text(text.replace("change(count(ice))", "change(count(count(ice) > 2))"))
    lines = powderdsl("show", tmp_path / "ice.yaml", "--cost", exits=0).stdout.splitlines()
    assert "step: native code, but 1 of 2 measures on tensors: count(…)" in lines


@pytest.mark.parametrize("name", RULESETS)
def test_show_as_json(name):
    data, rules = json.loads(powderdsl("show", name, "--json", exits=0).stdout), package.load(name)
    assert [row["name"] for row in data["elements"]] == [element.name for element in rules.elements]
    assert [row["name"] for row in data["passes"]] == [one.name for one in rules.passes]
    assert [row["substeps"] for row in data["passes"]] == [len(one.substeps) for one in rules.passes]
    assert {row["name"]: row["value"] for row in data["params"]} == {
        param.name: float(param.default) for param in rules.params
    }
    for row, element in zip(data["elements"], rules.elements, strict=True):
        values = {prop.name: prop.values[element.id] for prop in rules.properties}
        assert row["properties"] == {
            name: value if isinstance(value, int) else float(value) for name, value in values.items()
        }
    for row in data["reactions"]:
        assert {*row["from"], *row["to"]} <= {element.name for element in rules.elements}
        file, line = row["where"].rsplit(":", 1)
        assert row["rule"].split()[0] in Path(file).read_text().splitlines()[int(line) - 1]


# Reactions


def names(rules, ids):
    return {element.name for element in rules.elements if element.id in ids}


def test_reactions_know_what_becomes_what_and_what_stays():
    rules = package.load("powderworld")
    pairs = {
        (before, after)
        for _, ids, made in reactions(rules)
        for before in names(rules, ids)
        for after in names(rules, made)
    }
    assert ("ice", "water") in pairs
    assert ("lava", "stone") in pairs
    assert ("empty", "sand") in pairs  # out of a cloner
    assert ("wood", "empty") in pairs  # eaten by acid
    assert ("sand", "water") not in pairs
    assert ("empty", "wall") in pairs
    assert "wall" not in {before for before, _ in pairs}
    assert "wall" not in names(rules, moved_ids(rules))
    assert names(rules, unchanging_ids(rules)) == {"wall"}
    assert moved_ids(package.load("life")) == frozenset()


# Text


@pytest.mark.parametrize("name", compositions())
def test_every_model_has_a_text(name):
    rules = package.load(name)
    text = print_model(rules)
    assert text == print_model(rules)
    assert text.endswith("\n")
    assert not text.endswith("\n\n")
    assert all(f"\npass {one.name} of {one.pack}  # " in text for one in rules.passes)
    count = sum(len(substep.rules) for one in rules.passes for substep in one.substeps)
    lines = [
        line for line in text.splitlines() if line.startswith("    ") and not line.startswith("    let ")
    ]
    assert len(lines) == count
    assert all("# " in line for line in lines)


def test_expressions_have_no_more_parentheses_than_they_need(tmp_path):
    path = tmp_path / "grit.yaml"
    condition = "(grit or wall) and not (above is wall) and (count(wall) + 1) * 2 - (3 - count(grit)) > 4"
    path.write_text(PACK.replace("count(grit) == 1", condition))
    text = print_model(package.load("core", path), ["grit"])
    assert "(count((element in wall) in box) + 1) * 2 - (3 - count((element in grit) in box))" in text
    assert "not above.element in wall and " in text


def test_numbers_are_printed_exactly():
    assert [show_number(value) for value in (1, 0.5, Fraction(1, 3), Fraction(1, 4), -2.0, 1e20)] == [
        *("1", "0.5", "1/3", "0.25", "-2", "1e+20"),
    ]


def test_sets_are_printed_the_shorter_way_round():
    rules = package.load("powderworld")
    everything = [element.id for element in rules.elements]
    assert show_set(rules, everything) == "any"
    assert show_set(rules, everything[1:]) == "any but empty"
    assert show_set(rules, everything[2:]) == "any but (empty, wall)"
    assert show_set(rules, everything[:2]) == "(empty, wall)"
    assert show_set(rules, everything[:1]) == "empty"


# compile


@pytest.mark.parametrize("stage", ["tree", "model", "ir", "kernels"])
def test_every_stage_can_be_printed(stage, tmp_path):
    backend = "torch" if stage == "kernels" else "auto"
    given = ("compile", "powderworld", "--emit", stage, "--backend", backend)
    result = powderdsl(*given, exits=0)
    assert "rules/water.yaml" in result.stdout
    one = powderdsl(*given, "--pass", "melt")
    assert len(one.stdout) < len(result.stdout) / 5
    assert "rules/water.yaml" in one.stdout


@pytest.mark.parametrize("backend", ["wasm", "torch", "native"])
def test_every_backend_shows_its_kernels(backend):
    result = powderdsl("compile", "life", "--emit", "kernels", "--backend", backend, exits=0)
    assert len(result.stdout.splitlines()) > 10


def test_trees_show_rules_as_parsed():
    result = powderdsl("compile", "core+water", "--emit", "tree", "--pass", "melt")
    heading = "do: ice -> water if count(thaws) > 1 and interact < melt  # rules/water.yaml:"
    assert heading in result.stdout
    assert "      transform\n        name ice\n        name water\n        condition\n" in result.stdout


def test_trees_can_be_had_of_rules_that_are_wrong(tmp_path):
    path = tmp_path / "grit.yaml"
    path.write_text(PACK.replace("-> empty", "-> nothing_known"))
    powderdsl("compile", f"core+{path}", "--emit", "tree", exits=0)
    assert "PD301" in powderdsl("compile", f"core+{path}", "--emit", "model", exits=2).stderr
