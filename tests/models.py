"""Tests load the same rules again and again: a process checks and lowers each of them once."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import pytest

from powderdsl import compiler
from powderdsl.diagnostics import Diagnostic, Reporter
from powderdsl.ir import lower, stages
from powderdsl.model.declarations import PackDecl, RulesetDecl
from powderdsl.model.types import Ruleset

KEPT = 64
"""The largest number of results of each function that are kept."""


def remembered(function: Callable[..., Any], key: Callable[..., Hashable]) -> Callable[..., Any]:
    """The function with its last results kept. `key` is None for calls whose results are not kept.

    Keys are made of identities; the arguments are kept with the result, so that no other object gets their identity.
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


def check_once(
    packs: Sequence[PackDecl], ruleset: RulesetDecl | None, palette: Any, elsewhere: Any
) -> tuple[Ruleset, tuple[Diagnostic, ...]]:
    """The model of some packs, with what `check` reports."""
    reporter = Reporter()
    return _check(packs, ruleset, reporter, palette, elsewhere), reporter.diagnostics


def identities(
    packs: Sequence[PackDecl], ruleset: RulesetDecl | None, palette: Any, elsewhere: Any
) -> Hashable:
    """Declarations that were read from equal texts are the same objects."""
    lineage = ruleset.lineage if ruleset else ()
    left_out = ruleset.left_out if ruleset else {}
    return (
        tuple(map(id, packs)),
        tuple(id(decl.source) for decl in lineage),
        tuple((name, id(pack)) for name, pack in left_out.items()),
        None if palette is None else tuple(palette),
    )


_check = compiler.check
_checked = remembered(check_once, identities)
_lowered = remembered(lower.lower_ruleset, lambda ruleset: id(ruleset))
_optimized = remembered(stages.run_passes, lambda program, until=None: id(program) if until is None else None)


def check(
    packs: Sequence[PackDecl],
    ruleset: RulesetDecl | None,
    reporter: Reporter,
    palette: Any = None,
    elsewhere: Any = dict,
) -> Ruleset:
    """`compiler.check`, except that the declarations of one composition are checked once."""
    model, diagnostics = _checked(packs, ruleset, palette, elsewhere)
    for diagnostic in diagnostics:
        reporter.add(diagnostic)
    return model


@contextmanager
def compiled_once() -> Iterator[None]:
    """Meanwhile `load` and `lower` return the models and programs that they have returned before."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiler, "check", check)
        patch.setattr(lower, "lower_ruleset", _lowered)
        patch.setattr(stages, "run_passes", _optimized)
        yield
