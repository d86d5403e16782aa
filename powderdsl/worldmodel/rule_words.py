"""Rules as written on the command line, with packs added and left out: ``ruleset-pack+pack``."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from powderdsl.compiler import load, read, split_names
from powderdsl.diagnostics import Reporter


def pack_names(rules: str, words: Iterable[str]) -> tuple[str, ...]:
    """The names of packs that are given by name or as files. Raises CompileError for a file that is not a pack.

    A name of a pack of the rules, left out or not, stands for that pack.
    """
    known = _known(rules)
    found: dict[str, None] = {}
    for word in words:
        found |= dict.fromkeys([word] if word in known else _names_of(word))
    return tuple(found)


def leave_out(rules: str, packs: Iterable[str]) -> str:
    """The rules without some packs, which are given by name or as files."""
    plus, minus = split_names(rules)
    return _written(plus, [*minus, *pack_names(rules, packs)])


def add(rules: str, packs: Iterable[str]) -> str:
    """The rules with some packs, by name or as files: those that were left out come back, others are added."""
    plus, minus = split_names(rules)
    known = _known(rules)
    for word in packs:
        names = [word] if word in known else _names_of(word)
        minus = [name for name in minus if name not in names]
        if not all(name in known for name in names):
            plus.append(word)
    return _written(plus, minus)


def keep(rules: str, packs: Sequence[str]) -> str:
    """The rules with these packs alone. Those that the rules do not have are added."""
    kept = pack_names(rules, packs)
    gone = [pack for pack in load(rules).packs if pack not in kept]
    return add(leave_out(rules, gone), packs)


def _known(rules: str) -> tuple[str, ...]:
    """The packs that rules name, including those that are left out."""
    return _names_of(*split_names(rules)[0])


def _names_of(*words: str) -> tuple[str, ...]:
    reporter = Reporter()
    packs, _ = read(words, reporter)
    reporter.raise_if_errors()
    return tuple(pack.name.text for pack in packs)


def _written(plus: Sequence[str], minus: Iterable[str]) -> str:
    """Names joined by ``+``. What is left out stands behind a name, for a file's name may have a ``-`` of its own."""
    names = list(plus)
    plain = [number for number, name in enumerate(names) if not name.endswith((".yaml", ".yml"))]
    place = plain[0] if plain else len(names) - 1
    names[place] += "".join(f"-{name}" for name in dict.fromkeys(minus))
    return "+".join(names)
