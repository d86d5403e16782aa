"""Generates a universe's text from a seed and the pieces in `rules/universes/laws.yaml`, which explains their form."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from operator import eq, ge, le
from typing import Any, TypeVar

from powderdsl.diagnostics import Reporter
from powderdsl.syntax.sources import read_source, shipped
from powderdsl.syntax.yaml_tree import Node, Scalar, parse_yaml
from powderdsl.syntax.yaml_tree import Sequence as Items
from powderdsl.system.random import MASK, START_0, mix

T = TypeVar("T")
Pieces = Mapping[str, Any]
Phrase = tuple[str, str]
"""The word in rules, and the word in descriptions."""

MAX_SEED = 0xFFFFFFFF
PLACE = re.compile(r"<(\w+)(?: (\w+))?>")
RANGE = re.compile(r"(\w+)([+-]\d+)?\.\.(\w+)([+-]\d+)?")


@cache
def pieces() -> Pieces:
    """The pieces of universes."""
    source = read_source(shipped("rules") / "universes" / "laws.yaml", reporter := Reporter())
    tree = parse_yaml(source, reporter) if source else None
    reporter.raise_if_errors()
    assert tree is not None
    return plain(tree)


def plain(node: Node) -> Any:
    """A tree as text, lists and dictionaries."""
    if isinstance(node, Scalar):
        return node.text
    if isinstance(node, Items):
        return [plain(item) for item in node.items]
    return {key.text: plain(value) for key, value in node.entries}


@dataclass
class Draws:
    """Choices that depend on a seed and the number of earlier choices."""

    seed: int
    count: int = 0

    def below(self, limit: int) -> int:
        """A number from 0 to `limit` - 1."""
        self.count += 1
        low = mix((START_0 + self.seed) & MASK)
        return int(mix((low + self.count * 0x9E3779B1) & MASK)) * limit >> 32

    def pick(self, items: Sequence[T]) -> T:
        return items[self.below(len(items))]

    def shuffled(self, items: Iterable[T]) -> list[T]:
        rest = list(items)
        return [rest.pop(self.below(len(rest))) for _ in range(len(rest))]

    def within(self, text: str, known: Mapping[str, int] | None = None) -> int:
        """A number in a range such as ``2..7``, or ``2..pool-1`` with names from `known`."""
        match = RANGE.fullmatch(text)
        assert match is not None, text
        values = {**(known or {}), **{word: int(word) for word in match.group(1, 3) if word.isdecimal()}}
        low, high = values[match[1]] + int(match[2] or 0), values[match[3]] + int(match[4] or 0)
        return low + self.below(high - low + 1)


@dataclass
class Universe:
    """A partly drawn universe."""

    draws: Draws
    pieces: Pieces
    names: dict[str, str] = field(default_factory=dict)
    """The names of elements, by part."""
    tags: dict[str, str] = field(default_factory=dict)
    """The tags of elements, by part; no two elements share one."""
    levels: dict[str, int] = field(default_factory=dict)
    """The ranks of parts; reactions never turn a part into one of higher rank."""
    params: list[str] = field(default_factory=list)
    passes: dict[str, list[str]] = field(default_factory=dict)
    sentences: list[str] = field(default_factory=list)

    def law(self, law: Pieces, name: str, given: Mapping[str, str] | None = None) -> None:
        """Add a law if some parts fit it. `given`: the parts of some letters."""
        chosen = dict(given or {})
        for letter, choice in law.get("draws", {}).items():
            if not (parts := [*self.candidates(choice, chosen)]):
                return
            chosen[letter] = self.draws.pick(parts)
        if name in self.passes:
            name += f"_{sum(other.startswith(name) for other in self.passes) + 1}"
        words = Words(self, name, law.get("chances", {}))
        stand_for = {part: part for part in self.names} | chosen
        words.known |= {f"tag {part}": (tag, tag) for part, tag in self.tags.items()}
        words.known |= {letter: (self.names.get(part, part),) * 2 for letter, part in stand_for.items()}
        said = words.filled(law["about"])
        self.sentences.append(said[:1].upper() + said[1:])
        self.params += words.filled(law.get("params", ""), 0).splitlines()
        if "body" in law:
            body = words.filled(law["body"], 0).splitlines()
            self.passes[name] = self.block("pass", name=name, about=self.sentences[-1], body=body)

    def candidates(self, choice: str, chosen: Mapping[str, str]) -> Iterable[str]:
        """The parts of a group, or those with a lower, higher or equal rank than the part of a letter."""
        group, _, letter = choice.partition(" ")
        parts: list[str] = self.pieces["groups"][group]
        if letter:
            levels = {self.pieces["nothing"]: 0, **self.levels}
            level, fits = levels[chosen[letter]], {"above": ge, "level": eq}.get(group, le)
            parts = [part for part in parts if fits(levels[part], level)]
        return (part for part in parts if part not in chosen.values())

    def block(self, piece: str, **values: str | list[str]) -> list[str]:
        """The lines of a piece. Lists replace the lines that consist of their name."""
        lines: list[str] = []
        for line in self.pieces[piece].splitlines():
            alone = PLACE.fullmatch(line.strip())
            if alone and isinstance(inserted := values[alone[1]], list):
                indent = " " * (len(line) - len(line.lstrip()))
                lines += [indent + inner if inner else inner for inner in inserted]
            else:
                lines.append(PLACE.sub(lambda match: str(values[match[1]]), line))
        return lines


@dataclass
class Words:
    """The words of one law: each placeholder is drawn once."""

    universe: Universe
    name: str
    own: Mapping[str, str]
    """The named chances and numbers of the law; other chances are named after the law."""
    known: dict[str, Phrase] = field(default_factory=dict)

    def filled(self, text: str, form: int = 1) -> str:
        """A text with its placeholders filled in, for rules (0) or descriptions (1)."""
        return PLACE.sub(lambda match: self.phrase(match[1], match[2])[form], text)

    def phrase(self, word: str, letter: str | None) -> Phrase:
        key = f"{word} {letter}" if letter else word
        if key not in self.known:
            self.known[key] = self.drawn(word, letter)
        return self.known[key]

    def drawn(self, word: str, letter: str | None) -> Phrase:
        draws, choices = self.universe.draws, self.universe.pieces["words"].get(word)
        if isinstance(choices, str):
            return (str(draws.within(choices)),) * 2
        if choices is None:
            name = word + self.name.lstrip("abcdefghijklmnopqrstuvwxyz") if word in self.own else self.name
            chance = f"{draws.within(self.own.get(word) or self.universe.pieces['chances'][word])}%"
            self.universe.params.append(f"{name}: {chance}")
            return name, chance
        inner = replace(self, known={**self.known, "c": self.known[letter]}) if letter else self
        rule, said = draws.pick([*choices.items()])
        return inner.filled(rule, 0), inner.filled(said)


def _elements(universe: Universe) -> list[str]:
    """The lines of the elements, in the order of their tags. Their names, levels and kinds are drawn."""
    draws, laws = universe.draws, universe.pieces
    parts, tags = laws["parts"], universe.tags
    tags |= {part: row["tag"] for part, row in parts.items()}
    for same in laws["dealt"]:
        tags |= zip(same, draws.shuffled(tags[part] for part in same), strict=True)
    starts, *others = laws["names"]
    masses: dict[str, int] = {}
    lines: dict[str, str] = {}
    looks = zip(draws.shuffled(starts), draws.shuffled(laws["colors"]), strict=False)
    for (part, row), (start, color) in zip(parts.items(), looks, strict=False):
        kind = laws["kinds"][draws.pick(row["kinds"])]
        name = start + "".join(map(draws.pick, others))
        masses[part] = draws.within(row.get("mass", kind["mass"]), masses)
        universe.names[part] = name
        if "level" in row:
            universe.levels[part] = draws.within(row["level"])
        own = (tags[part], *filter(None, f"{kind['tags']}, {row.get('tags', '')}".split(", ")))
        (lines[tags[part]],) = universe.block(
            "element",
            name=name,
            id=str(int(laws["first_id"]) + [*laws["tags"]].index(tags[part])),
            mass=str(masses[part]),
            entry=kind["entry"],
            color=color,
            glyph=start,
            tags=", ".join(dict.fromkeys(own)),
            about=kind["says"],
        )
        if "law" in kind:
            universe.law(laws["laws"][kind["law"]], kind["law"], {"a": part})
    return [lines[tag] for tag in laws["tags"]]


def universe_text(seed: int) -> str:
    """The rule pack of a seed, as YAML. Raises ValueError for a seed outside of 0..2³²-1."""
    if not 0 <= seed <= MAX_SEED:
        raise ValueError(f"the seed of a universe must be from 0 to {MAX_SEED:,}, found {seed}")
    laws, draws = pieces(), Draws(seed)
    universe = Universe(draws, laws)
    elements = _elements(universe)
    for law in map(draws.pick, laws["always"]):
        universe.law(law, law["name"])
    for group in laws["free"]:
        for _ in range(draws.within(group["count"])):
            name = draws.pick(group["laws"])
            universe.law(laws["laws"][name], name)
    levels = {part: level for part, level in universe.levels.items() if level}
    sets = [
        ", ".join(universe.names[part] for part, level in levels.items() if level >= least)
        for least in sorted({*levels.values()}, reverse=True)
    ]
    lines = universe.block(
        "pack",
        seed=str(seed),
        laws=" ".join(universe.sentences),
        params=sorted(universe.params),
        tags=[f'{tag}: "{about}"' for tag, about in (laws["tags"] | laws["also_tagged"]).items()],
        elements=elements,
        passes=[line for pass_ in universe.passes.values() for line in pass_],
        invariants=[line for held in sets for line in universe.block("invariant", set=held)],
    )
    return "\n".join(lines) + "\n"
