"""The order in which passes run: by `after` and `before`, then by load order."""

from __future__ import annotations

import itertools

from powderdsl.diagnostics import Label, Reporter, Span
from powderdsl.model.composition.names import Named, Names, in_order, report_unknown
from powderdsl.model.declarations import PassDecl

MAX_PASSES = 200


def order_passes(
    passes: dict[str, Named[PassDecl]], names: Names, reporter: Reporter
) -> tuple[Named[PassDecl], ...]:
    """Sort passes by `after` and `before`, then by load order. `names` resolves names of passes."""
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
                other = names.of(named.pack, scalar.word)
                if other in passes:
                    first, second = (other, name) if is_after else (name, other)
                    earlier[second][first] = scalar.span
                elif not scalar.is_optional:
                    report_unknown("pass", scalar, passes, reporter)
    ordered, stuck = in_order(passes, earlier)
    if stuck:
        _report_cycle(stuck, earlier, reporter)
    return tuple(passes[name] for name in ordered)


def _report_cycle(waiting: list[str], earlier: dict[str, dict[str, Span]], reporter: Reporter) -> None:
    path = [waiting[0]]
    cycle: list[str] = []
    while not cycle:
        step = next(name for name in earlier[path[-1]] if name in waiting)
        if step in path:
            cycle = [*path[path.index(step) :], step]
        path.append(step)
    steps = [
        (earlier[later][first], f"`{first}` before `{later}`") for later, first in itertools.pairwise(cycle)
    ]
    (place, label), *more = steps
    message = "the order of passes is a cycle: " + " after ".join(f"`{name}`" for name in cycle)
    helps = ["take one of these names out of its `after` or `before`"]
    reporter.error("PD307", message, place, label, secondary=[Label(*step) for step in more], helps=helps)
