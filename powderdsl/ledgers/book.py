"""The ledger of a ruleset: what its rules create, destroy and move, and what follows for all worlds.

A verdict `Proven` holds for worlds of every size and every content, for all parameter values and all random numbers
that streams draw, at every step. `NotProven` names the lines of rules that stand in the way: it is no proof of the
contrary, for several rules may make up for each other.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

from powderdsl.ledgers.changes import Found, RuleLine, find_changes, ledger_facts
from powderdsl.model.types import Ruleset


@dataclass(frozen=True)
class Proven:
    """It holds in every world, at every step."""

    reason: str

    def __bool__(self) -> bool:
        return True


@dataclass(frozen=True)
class NotProven:
    """Not decided: these lines may break it."""

    reason: str
    rules: tuple[RuleLine, ...] = ()

    def __bool__(self) -> bool:
        return False


Verdict = Proven | NotProven


@dataclass(frozen=True)
class RuleEntry:
    """What one line may do, at most.

    `changes` are pairs (before, after) of elements: in a cell where the first was, the second is. `moves` are the
    elements that it carries away or pushes aside. `fires` is False if it is proven never to happen.
    """

    rule: RuleLine
    fires: bool
    changes: tuple[tuple[str, str], ...]
    moves: tuple[str, ...]


@dataclass(frozen=True)
class Ledger:
    """What the rules of a ruleset do, line by line, and what can be concluded. Elements go by their names.

    `complete` is False if the rules were too many to be asked about everything: then more is taken for possible.
    """

    name: str
    elements: tuple[str, ...]
    rules: tuple[RuleEntry, ...]
    complete: bool

    @cached_property
    def changes(self) -> dict[tuple[str, str], tuple[RuleLine, ...]]:
        """Every pair (before, after) that some rule may bring about, and the lines that may."""
        found: dict[tuple[str, str], tuple[RuleLine, ...]] = {}
        for entry in self.rules:
            for pair in entry.changes:
                found[pair] = (*found.get(pair, ()), entry.rule)
        return found

    def conserved(self, weights: Mapping[str, int]) -> Verdict:
        """Whether the weighted number of cells is constant: ``{"a": 1, "b": 1}`` is the sum of two elements.

        Elements that are not named count 0. Raises KeyError for a name that is no element.
        """
        return self._weighed(weights, "changes", lambda before, after: before != after)

    def never_rises(self, what: Mapping[str, int] | Iterable[str]) -> Verdict:
        """Whether the (weighted) number of cells with these elements never rises. Raises KeyError as `conserved`."""
        return self._weighed(_weights(what), "rises", lambda before, after: before < after)

    def never_falls(self, what: Mapping[str, int] | Iterable[str]) -> Verdict:
        """Whether the (weighted) number of cells with these elements never falls. Raises KeyError as `conserved`."""
        return self._weighed(_weights(what), "falls", lambda before, after: before > after)

    def unchanged(self, element: str) -> Verdict:
        """Whether a cell with this element keeps it for good. Others may still become it: see `never_rises`.

        Raises KeyError for a name that is no element.
        """
        self._known([element])
        lines = [
            entry.rule
            for entry in self.rules
            if element in entry.moves or any(before == element for before, _ in entry.changes)
        ]
        if not lines:
            return Proven(f"no rule moves `{element}` or turns it into anything")
        return NotProven(f"`{element}` may be moved or become something else", tuple(lines))

    def _weighed(self, weights: Mapping[str, int], verb: str, breaks) -> Verdict:  # type: ignore[no-untyped-def]
        self._known(weights)
        broken = {
            (a, b): lines
            for (a, b), lines in self.changes.items()
            if breaks(weights.get(a, 0), weights.get(b, 0))
        }
        if not broken:
            return Proven(f"no rule {_DOES[verb]} {_sum_text(weights)}")
        (before, after), _ = next(iter(broken.items()))
        lines = tuple(dict.fromkeys(line for found in broken.values() for line in found))
        more = f", and {len(broken) - 1} changes more" if len(broken) > 1 else ""
        return NotProven(f"`{before}` may become `{after}`{more}", lines)

    def _known(self, names: Iterable[str]) -> None:
        for name in names:
            if name not in self.elements:
                raise KeyError(f"no element `{name}` in {self.name}")


_DOES = {"changes": "alone changes", "rises": "adds to", "falls": "takes from"}


def _weights(what: Mapping[str, int] | Iterable[str]) -> Mapping[str, int]:
    return what if isinstance(what, Mapping) else dict.fromkeys(what, 1)


def _sum_text(weights: Mapping[str, int]) -> str:
    parts = [name if weight == 1 else f"{weight} {name}" for name, weight in weights.items() if weight]
    return f"`{' + '.join(parts)}`" if parts else "nothing"


def ledger(ruleset: Ruleset) -> Ledger:
    """The ledger of a checked ruleset: decided from its rules, no world is run."""
    facts = ledger_facts(ruleset)
    names = {element.id: element.name for element in ruleset.elements}
    entries = tuple(_entry(found, names) for found in find_changes(ruleset, facts))
    return Ledger(ruleset.name, tuple(names.values()), entries, not facts.budget.is_exhausted)


def _entry(found: Found, names: Mapping[int, str]) -> RuleEntry:
    changes = tuple((names[a], names[b]) for a, b in sorted(found.pairs))
    return RuleEntry(found.line, found.fires, changes, tuple(_named(found.moves, names)))


def _named(ids: Iterable[int], names: Mapping[int, str]) -> Iterator[str]:
    return (names[number] for number in sorted(ids))
