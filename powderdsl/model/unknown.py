"""Unknown names, gathered while rules are checked: each is reported once, with all its places."""

from __future__ import annotations

from collections.abc import Iterable

from powderdsl.diagnostics import Label, Reporter, Span, suggest
from powderdsl.model.builtins import FUNCTIONS
from powderdsl.model.symbols import Symbols

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
                helps=self._cure(name, places[first], after_dot),
            )
        self._places.clear()

    def _cure(self, name: str, known_here: tuple[str, ...], after_dot: bool) -> tuple[str, ...]:
        elsewhere = [qualified for qualified in self.symbols.params if qualified.endswith(f".{name}")]
        if elsewhere:
            return (f"write `{elsewhere[0]}`: a parameter of another pack is named with its pack",)
        known = self.symbols.names(after_dot=after_dot)
        close = suggest(name, known if after_dot else [*known, *known_here, *FUNCTIONS])
        if close and close[0].startswith("did"):
            return close
        return (f"load the pack that defines it, or write `{name}?` if that may be absent",)
