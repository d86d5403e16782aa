"""Generated universes: rule packs with invented elements and laws, made from a seed and `rules/universes/`.

The same seed gives the same text on every machine. Packs are correct by construction: no reaction increases the rank,
so nothing grows forever, and the pack claims the consequences.
"""

from __future__ import annotations

import re

from powderdsl.diagnostics import Reporter, Source, Span
from powderdsl.universes.invent import MAX_SEED, universe_text

__all__ = ["MAX_SEED", "PREFIX", "is_universe", "universe_source", "universe_text"]

PREFIX = "universe:"


def is_universe(word: str) -> bool:
    """True for names of universes, including invalid ones such as ``universe:x``."""
    return word.startswith(PREFIX)


def universe_seed(word: str, span: Span | None, reporter: Reporter) -> int | None:
    """The seed in a name such as ``universe:7``; None after reporting PD304."""
    number = word.removeprefix(PREFIX)
    seed = int(number) if re.fullmatch("[0-9]{1,10}", number) else -1
    if 0 <= seed <= MAX_SEED:
        return seed
    label = f"expected a number from 0 to {MAX_SEED:,} after the colon" if span else ""
    helps = [f"write a number from 0 to {MAX_SEED}, as in `{PREFIX}7`"]
    reporter.error("PD304", f"no universe `{number[:80]}`", span, label, helps=helps)
    return None


def universe_source(word: str, span: Span | None, reporter: Reporter) -> Source | None:
    """The pack with a name such as ``universe:7``; None after reporting PD304."""
    seed = universe_seed(word, span, reporter)
    return None if seed is None else Source(f"{PREFIX}{seed}", universe_text(seed))
