"""Tests load the same rules again and again: a process checks and lowers each of them once."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from powderdsl import compiler
from powderdsl.ir import lower, stages

KEPT = 64
"""The largest number of results of each function that are kept."""


def remembered(function: Callable[..., Any], key: Callable[..., Hashable]) -> Callable[..., Any]:
    """The function with its last results kept. `key` is None for calls whose results are not kept.

    Keys may be identities: the arguments are kept with the result, so that no other object gets their identity.
    """
    results: dict[Hashable, tuple[Any, ...]] = {}

    def call(*args: Any, **options: Any) -> Any:
        name = key(*args, **options)
        if name is None:
            return function(*args, **options)
        if name not in results:
            results[name] = function(*args, **options), args
            while len(results) > KEPT:
                results.pop(next(iter(results)))
        return results[name][0]

    return call


_persistent = remembered(compiler.persistent, lambda name, inputs, make: (name, inputs))
_lowered = remembered(lower.lower_ruleset, lambda ruleset: id(ruleset))
_optimized = remembered(stages.run_passes, lambda program, until=None: id(program) if until is None else None)


@contextmanager
def compiled_once() -> Iterator[None]:
    """Meanwhile `load` and `lower` return the models and programs that they have returned before."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiler, "persistent", _persistent)
        patch.setattr(lower, "lower_ruleset", _lowered)
        patch.setattr(stages, "run_passes", _optimized)
        yield
