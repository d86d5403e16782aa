"""`powderdsl trace`: its text, its JSON, and what it refuses."""

from __future__ import annotations

import json

import pytest

from tests.cli.commands import powderdsl

RULES = "core+sand+water"
FAST = ("--backend", "reference", "--world", "world.txt")


@pytest.fixture(autouse=True)
def _folder(folder):
    (folder / "world.txt").write_text("# s #\n# . #\n# ~ #\n# # #\n")


def test_the_text_names_the_rule_the_source_and_what_it_read():
    text = powderdsl("trace", RULES, *FAST, "--at", "1,1", "--step", 1, "--of", "element", exits=0).stdout
    assert "element: empty -> sand, moved here from 0,1" in text
    assert "swap below if density == d > below.density" in text
    assert "^^^^" in text
    assert "holds: below.density < 4; below.density is 1 (empty at 1,1)" in text


def test_a_near_miss_has_the_caret_under_the_part_that_failed():
    result = powderdsl("trace", RULES, *FAST, "--at", "2,1", "--step", 40, "--of", "element")
    lines = result.stdout.splitlines()
    first = next(number for number, line in enumerate(lines) if line == "almost, but for `below.density < 3`")
    source, carets = lines[first + 3], lines[first + 4]
    assert source[carets.index("^") : carets.rindex("^") + 1] == "d > below.density"
    assert "below.density is 4 (sand at 2,1)" in carets


def test_json_has_a_stable_form():
    data = json.loads(powderdsl("trace", RULES, *FAST, "--at", "1,1", "--step", 1, "--json", "--all").stdout)
    assert list(data) == ["schema", "ruleset", "world", "cell", "step", "slots", "writes", "almost"]
    assert (data["schema"], data["cell"], data["step"]) == (1, [1, 1], 1)
    element = data["slots"]["element"]
    assert (element["before"], element["after"]) == ("empty", "sand")
    keys = "number pack pass substep label text file line column"
    assert set(element["writer"]) == set(keys.split())
    write = next(one for one in data["writes"] if one["slot"] == "element")
    assert set(write) == {"slot", "before", "after", "how", "rule", "cell", "source", "parts"}
    assert (write["how"], write["cell"], write["source"]) == ("arrive", [0, 1], [0, 1])
    part = write["parts"][0]
    assert set(part) == {"text", "holds", "let", "file", "line", "column", "reads"}
    assert set(part["reads"][0]) == {"text", "value", "cell", "element", "counted"}
    assert set(data["almost"][0]) == {"rule", "cell", "failed", "held", "gave_way"}


def test_a_saved_world_has_several_to_choose_from():
    powderdsl(*f"run {RULES} --backend reference --batch 2 --size 4x5 --steps 3 --out w.npz".split(), exits=0)
    options = ("--backend", "reference", "--world", "w.npz", "--at", "0,0", "--step", 1, "--json")
    data = [json.loads(powderdsl("trace", RULES, *options, "--number", one).stdout) for one in (0, 1)]
    assert [one["world"] for one in data] == [0, 1]
    assert [one["step"] for one in data] == [4, 4]  # the saved world knows how many steps it has made
