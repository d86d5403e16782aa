"""For testing rules: random rulesets and worlds, tests of packs, invariants, mutants.

`worlds` and `rulesets` are strategies for Hypothesis, which nothing else here needs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from powderdsl.testing.generators.strategies import rulesets, worlds

__all__ = ["rulesets", "worlds"]


def __getattr__(name: str) -> Any:
    """The strategies, imported when they are first used."""
    if name not in __all__:
        raise AttributeError(f"module 'powderdsl.testing' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module("powderdsl.testing.generators.strategies"), name)
