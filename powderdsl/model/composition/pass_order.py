"""The order in which passes run: by `after` and `before`, then by load order."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

from powderdsl.diagnostics import Label, Reporter, Span, suggest
from powderdsl.model.composition.names import Names
from powderdsl.model.declarations import PassDecl

if TYPE_CHECKING:
    from powderdsl.model.composition.compose import Named

MAX_PASSES = 200


def order_passes(
    passes: dict[str, Named[PassDecl]], names: Names, reporter: Reporter
) -> tuple[Named[PassDecl], ...]:
    """Sort passes by `after` and `before`; what those leave open is decided by load order."""
    if len(passes) > MAX_PASSES:
        last = list(passes.values())[MAX_PASSES].decl.name.span
        reporter.error(
            "PD508", f"{len(passes):,} passes", last, f"the limit is {MAX_PASSES}", helps=["load fewer packs"]
        )
        return tuple(passes.values())
    earlier: dict[str, dict[str, Span]] = {name: {} for name in passes}
    for name, named in passes.items():
        for scalars, is_after in ((named.decl.after, True), (named.decl.before, False)):
            for scalar in scalars:
                word = scalar.text.removesuffix("?")
                other = names.of_pass(named.pack, word)
                if other in passes:
                    first, second = (other, name) if is_after else (name, other)
                    earlier[second][first] = scalar.span
                elif not scalar.text.endswith("?"):
                    reporter.error(
                        "PD301",
                        f"unknown pass `{word}`",
                        scalar.span,
                        "no loaded pack has it",
                        helps=[
                            *suggest(word, passes, "passes"),
                            f"if its pack may be absent, write `{word}?`",
                        ],
                    )
    ordered: list[str] = []
    waiting = list(passes)
    while waiting:
        ready = next((name for name in waiting if not set(earlier[name]) & set(waiting)), None)
        if ready is None:
            _report_cycle(waiting, earlier, reporter)
            return tuple(passes[name] for name in [*ordered, *waiting])
        waiting.remove(ready)
        ordered.append(ready)
    return tuple(passes[name] for name in ordered)


def _report_cycle(waiting: list[str], earlier: dict[str, dict[str, Span]], reporter: Reporter) -> None:
    path = [waiting[0]]
    cycle: list[str] = []
    while not cycle:
        step = next(name for name in earlier[path[-1]] if name in waiting)
        if step in path:
            cycle = [*path[path.index(step) :], step]
        path.append(step)
    labels = [
        Label(earlier[later][first], f"`{first}` before `{later}`")
        for later, first in itertools.pairwise(cycle)
    ]
    reporter.error(
        "PD307",
        "passes wait for each other: " + " after ".join(f"`{name}`" for name in cycle),
        labels[0].span,
        labels[0].text,
        secondary=labels[1:],
        helps=["take one of these names out of its `after` or `before`"],
    )
