"""Which sums of elements are constant, and which only rise or only fall: a graph of what may become what."""

from __future__ import annotations

from collections.abc import Iterable

Pairs = Iterable[tuple[str, str]]


def constant_sums(elements: tuple[str, ...], pairs: Pairs) -> tuple[tuple[str, ...], ...]:
    """The smallest sums that no single change alters; every other such sum is made of them.

    A change turns one cell of `a` into one of `b`: weights w keep the total if w(a) = w(b). So they are equal within
    each part of the graph that hangs together, and the parts are the sums.
    """
    group = {name: [name] for name in elements}
    for before, after in pairs:
        if group[before] is not group[after]:
            group[before] += group[after]
            for name in group[after]:
                group[name] = group[before]
    parts = {id(part): part for part in group.values()}.values()
    return tuple(in_order(elements, part) for part in parts)


def rising_sums(elements: tuple[str, ...], pairs: Pairs) -> tuple[tuple[str, ...], ...]:
    """For each element the smallest sum with it that nothing leaves, without those that are constant.

    It holds all that the element may become. Every other sum of different elements that cannot fall is joined of these
    and of constant ones.
    """
    pairs = tuple(pairs)
    whole = {frozenset(part) for part in constant_sums(elements, pairs)}
    closed = dict.fromkeys(_closure(name, pairs) for name in elements)
    return tuple(in_order(elements, part) for part in closed if part not in whole)


def falling_sums(elements: tuple[str, ...], pairs: Pairs) -> tuple[tuple[str, ...], ...]:
    """As `rising_sums`, for sums that nothing enters: all that may become the element."""
    return rising_sums(elements, [(after, before) for before, after in pairs])


def _closure(start: str, pairs: tuple[tuple[str, str], ...]) -> frozenset[str]:
    """Everything that `start` may become in any number of changes, and itself."""
    found, fresh = {start}, [start]
    while fresh:
        name = fresh.pop()
        more = [after for before, after in pairs if before == name and after not in found]
        found.update(more)
        fresh += more
    return frozenset(found)


def in_order(elements: tuple[str, ...], chosen: Iterable[str]) -> tuple[str, ...]:
    """Some elements in the order of their ids."""
    kept = set(chosen)
    return tuple(name for name in elements if name in kept)
