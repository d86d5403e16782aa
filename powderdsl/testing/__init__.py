"""For testing rules: random rulesets and worlds, tests of packs, invariants, mutants.

`worlds` and `rulesets` are strategies for Hypothesis, which nothing else here needs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from powderdsl.system.packages import importing

if TYPE_CHECKING:
    from powderdsl.testing.generators.strategies import rulesets, worlds

__all__ = ["rulesets", "worlds"]


__getattr__ = importing("powderdsl.testing.generators", strategies="rulesets worlds")
