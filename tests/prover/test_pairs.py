"""Pairs of rules written by hand: rewrites that are proven equal, and corners in which rules differ, with a world."""

from __future__ import annotations

import re
import time
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from powderdsl.compiler import load
from powderdsl.model.types import Ruleset
from powderdsl.testing.properties.comparison import Distinction, compare_rules
from powderdsl.testing.properties.running import Oracle, differences
from tests.tiers import tiered

SECONDS = 10
"""Each pair is decided within this time of one core."""

PAIRS = yaml.safe_load((Path(__file__).parents[1] / "data" / "pairs.yaml").read_text("utf-8"))
ALL = [(status, name) for status in ("equal", "differ") for name in PAIRS[status]]
LONGER = (
    "a range as two comparisons",
    "any of a loop as a count",
    "a symmetry written out",
    "a tag as a list",
    "the larger of two by a choice",
    "additions in one",
    "a square",
    "a policy that is not needed",
    "a pass that does nothing",
    "fields in another order",
    "a quotient of columns",
    "a remainder",
    "a smaller range",
    "set or added",
    "a product that is rare",
    "a direction",
    "one of two moves",
    "a condition after a move",
    "who has a field",
    "three fields at once",
)
"""Left to `make test-all`: others are of the same kind."""


def side(text: str, number: int) -> list[str]:
    """The files of one of the two sides of a pair."""
    text = re.sub(r"\[\[(.*?)\|\|(.*?)\]\]", lambda choice: choice[number + 1].strip(), text)
    lines = [re.fullmatch(r"( *)(?:([<>]) ?)?(.*)", line) for line in text.splitlines()]
    kept = [line[1] + line[3] for line in lines if line and line[2] in (None, "<>"[number])]
    first, *others = "\n".join(kept).split("\n---\n")
    if not first.startswith("pack:"):
        first = f"pack: pair\n{first}"
    if "elements:" not in first and "needs:" not in first:
        first = f"{first}\n{PAIRS['shared']}"
    return [first, *others]


def written(folder: Path, text: str, number: int) -> str:
    """RULES that name the files of a side."""
    paths = [folder / f"{'ab'[number]}{i}.yaml" for i, _ in enumerate(side(text, number))]
    for path, content in zip(paths, side(text, number), strict=True):
        path.write_text(content, "utf-8")
    return "+".join(map(str, paths))


@pytest.mark.parametrize("pair", tiered(ALL, [pair for pair in ALL if pair[1] not in LONGER]), ids=" ".join)
def test_pairs_are_decided(tmp_path: Path, pair: tuple[str, str]) -> None:
    status, name = pair
    first, second = (written(tmp_path, PAIRS[status][name], number) for number in (0, 1))
    before = time.process_time()
    rules = load(first), load(second)
    result = compare_rules(rules[0], second, rules[1], 60)
    assert time.process_time() - before < SECONDS
    assert result.status == status, result.reason
    if result.distinction is not None:
        replay(result.distinction, *rules)


def replay(shown: Distinction, first: Ruleset, second: Ruleset) -> None:
    """The reference gives the two worlds that were found, for rules whose names agree after the pack's."""
    words = {param.name.rpartition(".")[2]: param.name for param in first.params}
    idents = {stream.name.rpartition(".")[2]: stream.ident for stream in first.streams}
    streams = [replace(s, ident=idents.get(s.name.rpartition(".")[2], s.ident)) for s in second.streams]
    params = {
        param.name: shown.sample.params[words[param.name.rpartition(".")[2]]]
        for param in second.params
        if shown.sample.params
    }
    theirs = replace(shown.sample, params=params)
    sides = (first, shown.sample), (replace(second, streams=tuple(streams)), theirs)
    ends = [Oracle(rules).states(sample, shown.steps, shown.draws or None)[-1] for rules, sample in sides]
    assert differences(*ends, [shown.slot]).any()
    for end, found in zip(ends, (shown.first, shown.second), strict=True):
        assert not differences(end, found, [shown.slot]).any()


def test_there_are_enough_pairs() -> None:
    assert min(len(PAIRS["equal"]), len(PAIRS["differ"])) >= 20
    assert {name for _, name in ALL} > set(LONGER)
