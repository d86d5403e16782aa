"""One layout: it changes nothing that a file says, loses no comment, and formats what it has formatted to the same."""

from __future__ import annotations

import random
import re
from pathlib import Path

import pytest

from powderdsl.compiler import load
from powderdsl.diagnostics import Reporter, Source
from powderdsl.editing.layout import formatted
from powderdsl.system.settings import fingerprint
from powderdsl.universes import universe_text
from tests.cli.commands import PACK, powderdsl

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted(
    [*ROOT.glob("rules/*.yaml"), *ROOT.glob("tasks/**/*.yaml"), *ROOT.glob("docs/examples/*.yaml")]
)


def layout(text: str) -> str:
    reporter = Reporter()
    result = formatted(Source("file.yaml", text), reporter)
    reporter.raise_if_errors()
    assert result is not None
    return result


def test_shipped_files_have_it() -> None:
    for path in FILES:
        text = path.read_text(encoding="utf-8")
        assert layout(text) == text, path


def indented(text: str, times: int) -> str:
    """A text with all indentation several times as wide."""
    return re.sub(r"^ +", lambda blanks: blanks[0] * times, text, flags=re.MULTILINE)


@pytest.mark.parametrize("name", ["water", "wind", "life", "powderworld2", "bird", "cloner"])
def test_indentation_is_restored(name: str) -> None:
    text = (ROOT / "rules" / f"{name}.yaml").read_text(encoding="utf-8")
    assert layout(indented(text, 2)) == text


def scrambled(text: str, draw: random.Random) -> tuple[str, int]:
    """A pack in another layout, with comments in random places; and how many comments there are."""
    lines, comments = [], 0
    for line in indented(text, draw.choice([1, 2, 3])).split("\n"):
        if draw.random() < 0.2:
            lines.append(" " * draw.randrange(9) + f"# comment {comments}")
            comments += 1
        if draw.random() < 0.1:
            lines += [""] * draw.randrange(3)
        if draw.random() < 0.2:
            line = re.sub(r"^(\s*\w+:) (?=\w)", r"\1    ", line)
        if draw.random() < 0.2 and not line.endswith("|"):
            line += " " * draw.randrange(3)
        lines.append(line)
    return "\n".join(lines), comments


@pytest.mark.parametrize("count", [12, pytest.param(1000, marks=pytest.mark.slow)])
def test_generated_packs_keep_their_meaning_and_comments(folder: Path, count: int) -> None:
    draw = random.Random(count)
    path = folder / "pack.yaml"
    for seed in range(count):
        text, comments = scrambled(universe_text(seed), draw)
        result = layout(text)
        assert layout(result) == result
        assert re.findall("# comment [0-9]+", result) == [f"# comment {number}" for number in range(comments)]
        path.write_text(text)
        before = fingerprint(load(str(path)))
        path.write_text(result)
        assert fingerprint(load(str(path))) == before


def test_the_command_writes_checks_and_compares(folder: Path) -> None:
    path = folder / "grit.yaml"
    path.write_text(PACK)
    assert powderdsl("fmt", path, exits=0).stdout == ""
    other = indented(PACK, 2).replace("pack: grit", "pack:   grit") + "\n\n"
    path.write_text(other)
    assert powderdsl("fmt", path, "--check", exits=1).stdout.split() == [str(path)]
    assert "-pack:   grit\n+pack: grit\n" in powderdsl("fmt", path, "--diff", exits=1).stdout
    assert path.read_text() == other
    powderdsl("fmt", path, exits=0)
    assert path.read_text() == PACK
    path.write_text("a: [")
    assert "PD103" in powderdsl("fmt", path, exits=2).output
    assert path.read_text() == "a: ["
