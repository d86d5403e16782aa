"""Unknown names, gathered while rules are checked: each is reported once, with all its places."""

from __future__ import annotations

from collections.abc import Iterable

from powderdsl.diagnostics import Label, Reporter, Span, suggest
from powderdsl.model.builtins import FUNCTIONS
from powderdsl.model.expressions.symbols import Symbols

ELSEWHERE = {
    "up": "write `above`",
    "north": "write `above`",
    "top": "write `above`",
    "down": "write `below`",
    "south": "write `below`",
    "bottom": "write `below`",
    "west": "write `left`",
    "east": "write `right`",
    "self": "a rule speaks of its own cell already: leave it out, or write `here`",
    "this": "a rule speaks of its own cell already: leave it out, or write `here`",
    "true": "write `yes`",
    "false": "write `no`",
    "none": "name the element that stands for nothing, such as `empty`",
    "nothing": "name the element that stands for nothing, such as `empty`",
    "air": "name the element that stands for nothing, such as `empty`",
    "neighbors": "count them: `count(SET)`, `count(SET in ring)`",
    "neighbours": "count them: `count(SET)`, `count(SET in ring)`",
    "random": "say `with chance 5%` at the end of the rule, or compare a stream: `luck < 5%`",
    "rand": "say `with chance 5%` at the end of the rule, or compare a stream: `luck < 5%`",
    "probability": "say `with chance 5%` at the end of the rule",
    "floor": "`a div b` divides integers and rounds down",
    "round": "`a div b` divides integers and rounds down",
    "ceil": "`a div b` divides integers and rounds down: `(a + b - 1) div b` rounds up",
    "int": "`a div b` divides integers and rounds down",
    "sqrt": "there are no roots; `length(VEC2)` is the length of a vector",
    "pow": "powers are written out: `x * x`",
    "distance": "`length(VEC2)` is the length of a vector",
}
"""Words of other languages that nothing here has, and what to write."""

MAX_PLACES = 4
"""Places of one name that are shown besides the first."""


class UnknownNames:
    """What was looked up and not found."""

    def __init__(self, symbols: Symbols, reporter: Reporter):
        self.symbols = symbols
        self.reporter = reporter
        self._places: dict[tuple[str, bool], dict[Span, tuple[str, ...]]] = {}

    def add(self, name: str, span: Span, known_here: Iterable[str], *, after_dot: bool) -> None:
        """Remember a name at a place. `known_here` are local names that it could have been meant for."""
        self._places.setdefault((name, after_dot), {})[span] = tuple(known_here)

    def report(self) -> None:
        """Report every name that came up, then forget them."""
        for (name, after_dot), places in self._places.items():
            first, *others = sorted(places, key=lambda span: (span.source.name, span.start))
            rest = len(others) - MAX_PLACES
            self.reporter.error(
                "PD301",
                f"unknown name `{name}`",
                first,
                "no loaded pack has such a field or property" if after_dot else "no loaded pack defines it",
                secondary=[Label(span, "and here") for span in others[:MAX_PLACES]],
                notes=[f"and in {rest} more places"] if rest > 0 else [],
                helps=self._fix(name, places[first], after_dot),
            )
        self._places.clear()

    def _fix(self, name: str, known_here: tuple[str, ...], after_dot: bool) -> tuple[str, ...]:
        elsewhere = [qualified for qualified in self.symbols.params if qualified.endswith(f".{name}")]
        if elsewhere:
            return (f"write `{elsewhere[0]}`: a parameter of another pack is named with its pack",)
        if not after_dot and name.lower() in ELSEWHERE:
            return (ELSEWHERE[name.lower()],)
        known = self.symbols.names(after_dot=after_dot)
        close = suggest(name, known if after_dot else [*known, *known_here, *FUNCTIONS])
        if close and close[0].startswith("did"):
            return close
        return (f"load the pack that defines it, or write `{name}?` if that may be absent",)
