"""A task as worlds without an agent: under other rules, and with fewer elements to draw."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import torch

from powderdsl.diagnostics import CompileError, Reporter, Span
from powderdsl.model.fingerprint import fingerprint
from powderdsl.model.types import Ruleset
from powderdsl.tasks.task import NO_CHANGE, Drawing, Generator, Goal, Split, Stamp, Task

NOTHING = 255
"""In stamps: leave the cell as it is."""


@dataclass(frozen=True)
class Watched:
    """`task` has one split, ``split``, of those worlds that the rules can have; `missing` says what the others lack.

    `missing` has an entry for each other world: its name, the names of elements that the rules do not have, and a place.
    """

    task: Task
    missing: tuple[tuple[str, tuple[str, ...], Span | None], ...]


class SplitWorlds:
    """The worlds of a task's split under some rules, before any of them starts."""

    def __init__(self, found: Watched, device: torch.device):
        self.found = found
        self.rules: Ruleset = found.task.ruleset
        self.size = found.task.size
        """Rows and columns."""
        self.names = tuple(variant.name for variant in found.task.splits[0].variants)
        """The names of the variants: seed s gives variant s mod their number."""
        self.device = device
        """Where worlds are run."""

    @property
    def fingerprint(self) -> str:
        """A name for how these worlds start, besides their rules: another if the task's file has been changed."""
        return fingerprint(self.found.task.splits)


def watched(
    task: Task, split: str, rules: Ruleset, only: Collection[str] = (), *, partly: bool = False
) -> Watched:
    """The worlds of a split under other rules.

    Elements are found by qualified name. A statement that draws one of several draws among those that the rules have,
    and also among the elements of packs that the task does not know; of these among the elements of the packs `only`,
    if any of them has elements. An element that is named alone must be there.

    Args:
        partly: leave out variants that the rules cannot have, as long as one remains.

    Raises:
        CompileError: PD604 if worlds need elements that the rules do not have.
    """
    given = task.split(split)
    kept, missing = [], []
    for variant in given.variants:
        narrowing = _Narrowing(task.ruleset, rules, only)
        found = narrowing.generator(variant)
        if narrowing.missing:
            missing.append((variant.name, tuple(dict.fromkeys(narrowing.missing)), narrowing.span))
        else:
            kept.append(found)
    if missing and not (partly and kept):
        raise _lacking(task, rules, missing, only)
    agent = replace(task.agent, choices=(NO_CHANGE,), speed_field=None)
    nothing = Goal(None, None, None, None)
    one = Split(given.name, given.about, tuple(kept))
    return Watched(replace(task, ruleset=rules, agent=agent, goal=nothing, splits=(one,)), tuple(missing))


class _Narrowing:
    """Generators with the ids of other rules. Names of elements that these rules lack are collected."""

    def __init__(self, own: Ruleset, rules: Ruleset, only: Collection[str]):
        others = {element.id: rules.element(element.qualified) for element in own.elements}
        self.ids = {number: other.id for number, other in others.items() if other is not None}
        self.names = {element.id: element.name for element in own.elements}
        packs = {element.pack for element in rules.elements}
        chosen = (packs & {*only}) or packs
        self.drawn = {one.id for one in own.elements if one.id in self.ids and one.pack in chosen}
        self.added = tuple(
            one.id for one in rules.elements if one.pack not in own.packs and one.pack in chosen
        )
        self.missing: list[str] = []
        self.span: Span | None = None

    def generator(self, given: Generator) -> Generator:
        drawn = {drawing.stamp for group in given.groups for drawing in group.drawings}
        return replace(
            given,
            fill=self.id(given.fill),
            groups=tuple(
                replace(group, drawings=tuple(map(self.drawing, group.drawings))) for group in given.groups
            ),
            stamps=tuple(self.stamp(one) for one in given.stamps if one.name in drawn),
            targets=(),
        )

    def drawing(self, drawing: Drawing) -> Drawing:
        if len(drawing.ids) > 1:
            ids = tuple(self.ids[one] for one in drawing.ids if one in self.drawn) + self.added
            if not ids:
                self.lack(drawing.ids, drawing.span)
        else:
            ids = tuple(self.id(one, drawing.span) for one in drawing.ids)
        over = drawing.over
        if over is not None:
            over = frozenset(self.ids[one] for one in over if one in self.ids)
        return replace(drawing, ids=ids, over=over)

    def stamp(self, stamp: Stamp) -> Stamp:
        rows = tuple(tuple(one if one == NOTHING else self.id(one) for one in row) for row in stamp.rows)
        return replace(stamp, rows=rows)

    def id(self, one: int, span: Span | None = None) -> int:
        if one not in self.ids:
            self.lack((one,), span)
        return self.ids.get(one, 0)

    def lack(self, ids: Sequence[int], span: Span | None) -> None:
        self.missing += [self.names[one] for one in ids]
        self.span = self.span or span


def _lacking(
    task: Task,
    rules: Ruleset,
    missing: Sequence[tuple[str, tuple[str, ...], Span | None]],
    only: Collection[str],
) -> CompileError:
    reporter = Reporter()
    under = f"{rules.name} with {', '.join(sorted(only))} alone" if only else rules.name
    for name, elements, span in missing:
        reporter.error(
            "PD604",
            f"the worlds `{name}` of {task.name} need elements that are not in {under}",
            span,
            "none of these can be drawn" if span else "",
            notes=[f"they need {', '.join(elements)}"],
            helps=["add the packs that have them, or choose other worlds with `--split` or `--task`"],
        )
    return CompileError(reporter.diagnostics)
