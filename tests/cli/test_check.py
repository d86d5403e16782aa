"""`powderdsl check`."""

from __future__ import annotations

import json
import re

import pytest

from tests.cli.commands import PACK, powderdsl


@pytest.fixture
def pack(folder):
    """Writes a changed PACK; the name to check it under."""

    def write(old: str = "", new: str = "", name: str = "grit.yaml") -> str:
        assert old in PACK
        (folder / name).write_text(PACK.replace(old, new) if old else PACK)
        return f"core+{name}"

    return write


def test_a_clean_ruleset_is_one_line():
    result = powderdsl("check", "powderworld", exits=0)
    line = r"powderworld: 14 elements, 12 passes, \d+ invariants \(all proven\), no errors\n"
    assert re.fullmatch(line, result.stdout)
    assert result.stderr == ""


def test_all_errors_come_at_once(pack):
    result = powderdsl(
        "check", pack("count(grit) == 1 and interact < vanish", "count(grid) == vanis"), exits=2
    )
    assert "error[PD301]" in result.stdout
    assert "grit.yaml:10" in result.stdout
    assert "^" in result.stdout
    assert "powderdsl explain PD301" in result.stdout
    assert result.stdout.splitlines()[-1].startswith("core+grit.yaml: ")


def test_warnings_are_errors_only_on_request(pack):
    rules = pack("do: ", "do: grit -> empty if grit and not grit\n    then: ")
    result = powderdsl("check", rules, exits=0)
    assert "warning[PD503]" in result.stdout
    assert ", no errors, " in result.stdout
    powderdsl("check", rules, "--warnings-as-errors", exits=1)
    powderdsl("check", rules, "nope", "--warnings-as-errors", exits=2)


def test_notes_are_shown_on_request(pack):
    rules = pack("grit -> empty", "grit -> lava?")
    quiet, loud = powderdsl("check", rules), powderdsl("check", rules, "--notes")
    assert "note[" not in quiet.stdout
    assert "(--notes shows them)" in quiet.stdout
    assert "note[PD506]" in loud.stdout
    assert "(--notes shows them)" not in loud.stdout
    assert quiet.exit_code == loud.exit_code == 0


def test_json_is_one_list(pack):
    result = powderdsl("check", pack("vanish: 20%", "vanish: 120%"), "nope", "--json", exits=2)
    found = json.loads(result.stdout)
    assert {one["severity"] for one in found} == {"error"}
    assert found[-1]["code"] == "PD304"
    assert found[0]["primary"]["span"]["start"] == {"line": 4, "column": 18}


def test_files_that_are_not_there(tmp_path):
    assert "PD101" in powderdsl("check", tmp_path / "none.yaml").stdout
    powderdsl("check", tmp_path, exits=2)
    powderdsl("check", "", exits=2)
    powderdsl("check", "core+", exits=2)


def test_the_ledger_follows_the_summary(pack):
    result = powderdsl("check", pack(), "--ledger", exits=0)
    assert "ledger of core+grit: 3 elements" in result.stdout
    assert "  becomes empty: grit.yaml:10 (grit)\n" in result.stdout
    assert "  never rises  grit\n" in result.stdout


def test_the_ledger_as_json(pack):
    data = json.loads(powderdsl("check", rules := pack(), "life", "--ledger", "--json").stdout)
    assert list(data) == ["diagnostics", "ledger"]
    ledger = data["ledger"][rules]
    assert list(ledger) == [
        "schema", "name", "complete", "constant_sums", "never_falls", "never_rises", "elements", "rules", "fields", "overlaps",
    ]  # fmt: skip
    assert ledger["schema"] == 1
    assert ledger["constant_sums"] == [["empty", "grit"], ["wall"]]
    grit = next(one for one in ledger["elements"] if one["name"] == "grit")
    (number,) = grit["becomes"]["empty"]
    assert ledger["rules"][number] == {
        "rule": "grit -> empty if count(grit) == 1 and interact < vanish",
        "where": "grit.yaml:10",
        "pass": "grit",
        "pack": "grit",
        "fires": True,
        "changes": [["grit", "empty"]],
        "moves": [],
        "needs": [["grit"]],
        "copies": [],
    }


def test_an_invariant_that_is_easily_broken_is_an_error(pack):
    rules = pack("passes:", "invariants: [count(grit) never falls]\npasses:")
    result = powderdsl("check", rules, exits=2)
    assert "error[PD512]: this invariant is broken after 1 step" in result.stdout
    assert "11 |     do: grit -> empty" in result.stdout  # the rule that breaks it
    assert "= note: before   after" in result.stdout
    data = json.loads(powderdsl("check", rules, "--json").stdout)
    assert [one["code"] for one in data] == ["PD512"]
