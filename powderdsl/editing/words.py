"""The words of loaded rules: their meanings, definitions and occurrences."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache

from powderdsl.diagnostics import Source, Span
from powderdsl.model.builtins import COORDINATES, DIRECTION_SETS, DIRECTIONS, KERNELS
from powderdsl.model.declarations import PackDecl
from powderdsl.model.operations import FUNCTIONS
from powderdsl.syntax.parse import reserved_words

TEXT = re.compile(r'(^|\s)#.*$|\babout:\s*("[^"]*"|[^,}\n]*)', re.MULTILINE)
"""Comments and sentences, which contain no names."""


@dataclass(frozen=True)
class Word:
    """A word of the rules, or a completion. `span` is its definition in a file; words of the language have none."""

    name: str
    kind: str
    about: str = ""
    span: Span | None = None
    pack: str = ""


def definitions(packs: Sequence[PackDecl]) -> Iterator[Word]:
    """The words that packs define, in the order of the files."""
    for pack in packs:
        sections = (
            pack.elements, pack.tags, pack.properties, pack.fields, pack.params, pack.sets, pack.kernels, pack.streams,
            pack.passes,
        )  # fmt: skip
        for section in sections:
            for entry in section:
                about = getattr(entry, "about", "")
                kind = entry.NOUN.partition(" ")[2]
                yield Word(entry.name.text, kind, about, entry.name.span, pack.name.text)


@cache
def language_words() -> tuple[Word, ...]:
    """The words of the language itself."""
    words = [
        Word(function.name, "function", f"`{function.usage}`: {function.about}")
        for function in FUNCTIONS.values()
    ]
    for kind, names in (("direction", DIRECTIONS), ("directions", DIRECTION_SETS), ("kernel", KERNELS)):
        words += [Word(name, kind) for name in names]
    others = {*reserved_words(), *COORDINATES} - {word.name for word in words}
    return (*words, *(Word(name, "keyword") for name in sorted(others)))


def occurrences(name: str, sources: Iterable[Source]) -> Iterator[Span]:
    """The places where a name occurs in the lines of files."""
    pattern = re.compile(rf"(?<![\w]){re.escape(name)}(?![\w])")
    for source in sources:
        hidden = [match.span() for match in TEXT.finditer(source.text)]
        for match in pattern.finditer(source.text):
            if not any(begin <= match.start() < end for begin, end in hidden):
                yield Span(source, match.start(), match.end())
