"""Tables and JSON, as all commands write them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from powderdsl.cli.output import print_json
from powderdsl.system.reports import Painted, table


@dataclass(frozen=True)
class Row:
    from_: str
    seen: frozenset[str]
    file: Path


def test_columns_are_aligned_and_numbers_are_to_the_right():
    rows = [["name", "cells", "rate", "about"], ["a", "12", "1,234", "2nd"], ["bcd", "?", "12.3M", "one"]]
    assert list(table(rows, indent="")) == [
        "name  cells   rate  about",
        "a        12  1,234  2nd",
        "bcd       ?  12.3M  one",
    ]
    assert list(table(rows[:1])) == ["  none"]


def test_only_painted_cells_have_terminal_codes():
    rows = [["color"], [Painted("\x1b[1mred\x1b[0m")], ["\x1b[1m"]]
    assert list(table(rows)) == ["  color", "  \x1b[1mred\x1b[0m", "  \\u001b[1m"]


def test_dataclasses_are_objects(capsys):
    print_json([Row("ice", frozenset({"b", "a"}), Path("x.yaml"))])
    data = json.loads(capsys.readouterr().out)
    assert data == [{"from": "ice", "seen": ["a", "b"], "file": "x.yaml"}]
