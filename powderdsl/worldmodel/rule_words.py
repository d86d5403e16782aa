"""What stands for rules on the command line, with packs added and left out: ``ruleset-pack+pack``."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from powderdsl.compiler import load, split_names


def leave_out(rules: str, packs: Iterable[str]) -> str:
    """The rules without some packs."""
    plus, minus = split_names(rules)
    return _written(plus, [*minus, *packs])


def add(rules: str, packs: Iterable[str]) -> str:
    """The rules with some packs: those that were left out come back, others are added."""
    plus, minus = split_names(rules)
    packs = list(packs)
    minus = [name for name in minus if name not in packs]
    there = load(_written(plus, minus)).packs
    return _written([*plus, *(pack for pack in packs if pack not in there)], minus)


def keep(rules: str, packs: Sequence[str]) -> str:
    """The rules with these packs alone. Those that the rules do not have are added."""
    gone = [pack for pack in load(rules).packs if pack not in packs]
    return add(leave_out(rules, gone), packs)


def _written(plus: Sequence[str], minus: Iterable[str]) -> str:
    """Names joined by ``+``. What is left out stands behind a name, for a file's name may have a ``-`` of its own."""
    names = list(plus)
    plain = [number for number, name in enumerate(names) if not name.endswith((".yaml", ".yml"))]
    place = plain[0] if plain else len(names) - 1
    names[place] += "".join(f"-{name}" for name in dict.fromkeys(minus))
    return "+".join(names)
