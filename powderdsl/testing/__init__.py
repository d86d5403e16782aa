"""Testing rules: random start worlds, tests of packs, invariants, mutants.

`worlds` is a Hypothesis strategy; the rest does not need Hypothesis.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from powderdsl.system.packages import importing

if TYPE_CHECKING:
    from powderdsl.testing.generators.strategies import worlds

__all__ = ["worlds"]

__getattr__, __dir__ = importing("powderdsl.testing", {"generators.strategies": "worlds"})
