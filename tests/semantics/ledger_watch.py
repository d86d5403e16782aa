"""Watches the reference interpreter, substep by substep, and holds what rules do against a ledger."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from powderdsl.analysis.changes import RuleLine, rule_line
from powderdsl.analysis.ledger import Ledger, RuleEntry
from powderdsl.analysis.overlaps import order_matters
from powderdsl.model import reference
from powderdsl.model.types import ELEMENT, Assign, Moment, Move, Pass, Ruleset, Swap, Transform, footprint

Array = np.ndarray[Any, Any]


@dataclass
class Watch:
    """What happened while the reference ran, and what of it the ledger denies."""

    ruleset: Ruleset
    ledger: Ledger
    happened: set[RuleLine] = field(default_factory=set)
    changed: set[tuple[RuleLine, str, str]] = field(default_factory=set)
    moved: set[tuple[RuleLine, str]] = field(default_factory=set)
    met: set[tuple[RuleLine, RuleLine]] = field(default_factory=set)
    denied: list[str] = field(default_factory=list)
    existing: Array | None = None
    """bool [B, ids]: what cells held or fields named since the step began."""

    def __post_init__(self) -> None:
        self.names = {element.id: element.name for element in self.ruleset.elements}
        self.entries: dict[RuleLine, RuleEntry] = {entry.rule: entry for entry in self.ledger.rules}
        overlaps = self.ledger.overlaps
        self.may_meet = {(one.first, one.second) for one in overlaps if not one.field}
        self.writes = {(one.first, one.second, one.field) for one in overlaps}
        self.pass_of: dict[int, Pass] = {
            id(moment): pass_ for pass_ in self.ruleset.passes for moment in pass_.moments
        }

    @contextmanager
    def running(self) -> Iterator[None]:
        """Everything that the reference runs meanwhile is watched."""
        run_moment, run_step = reference.run_moment, reference.step

        def watched_moment(moment: Moment, at: Any, table: Any) -> Any:
            wanted, masks = self._masks(moment, replace(at, lets=dict(at.lets)))
            before = at.state["element"]
            after = run_moment(moment, at, table)
            self._look(moment, wanted, masks, before, after["element"])
            self.existing |= self._held(after)
            return after

        def watched_step(ruleset: Ruleset, state: Any, *rest: Any, **more: Any) -> Any:
            self.existing = self._held(state)
            return run_step(ruleset, state, *rest, **more)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(reference, "run_moment", watched_moment)
            patch.setattr(reference, "step", watched_step)
            yield

    def _held(self, state: Any) -> Array:
        """bool [B, ids]: what cells hold, and fields that last name."""
        fields = [item.name for item in self.ruleset.fields if item.kind == ELEMENT and not item.resets]
        held = np.stack([state[name] for name in ("element", *fields)], 1)
        numbers = range(self.ruleset.slots)
        return np.stack([(held == number).any((1, 2, 3)) for number in numbers], 1)

    def _masks(self, moment: Moment, at: Any) -> tuple[dict[int, Array], dict[int, Array]]:
        """Where the rules of a substep want to happen, and where they do."""
        for let in moment.lets:
            at.lets[let.name] = reference.evaluate(let.value, at)
        wanted = {id(rule): reference.evaluate(rule.mask, at) for rule in moment.rules}
        masks = dict(wanted)
        if moment.policy in ("drop_both", "first_wins"):
            claims = [rule for rule in moment.rules if not isinstance(rule, Assign)]
            reference._settle_claims(moment.policy, claims, masks)
        return wanted, masks

    def _look(self, moment: Moment, wanted: Any, masks: Any, before: Array, after: Array) -> None:
        pass_ = self.pass_of[id(moment)]
        explained = np.zeros(before.shape, bool)
        for rule in moment.rules:
            mask = masks[id(rule)]
            if not mask.any():
                continue
            line = rule_line(rule, pass_)
            self._happens(line, mask)
            if isinstance(rule, Assign):
                continue
            for dy, dx in footprint(rule):
                explained |= reference.look(mask, (-dy, -dx))
            if isinstance(rule, Transform):
                alone = mask.copy()
                for other in moment.rules:
                    if other is not rule and not isinstance(other, Assign):
                        alone &= ~self._claimed(other, masks[id(other)])
                self._changes(line, before[mask], after[mask], np.nonzero(mask)[0], alone[mask])
            else:
                self._moves(rule, line, mask, before, after)
                if isinstance(rule, Move) and rule.leaving is not None:
                    self._overwrites(rule, line, moment, masks, before)
        self._expect(bool((explained | (before == after)).all()), f"{pass_.name}: a change without a rule")
        self._write(moment, pass_, masks)
        if moment.policy != "prove":
            self._meet(moment, pass_, wanted)

    def _happens(self, line: RuleLine, mask: Array) -> None:
        self.happened.add(line)
        entry = self.entries[line]
        self._expect(entry.fires, f"{line} happens")
        assert self.existing is not None
        worlds = mask.any((1, 2))
        for names in entry.needs:
            ids = [number for number, name in self.names.items() if name in names]
            has = self.existing[:, ids].any(1)
            self._expect(bool((has | ~worlds).all()), f"{line} happens without any of {names}")

    def _changes(self, line: RuleLine, before: Array, after: Array, worlds: Array, alone: Array) -> None:
        """Look at the cells that a line changes. Where it is not `alone`, another rule may have made what is there."""
        entry = self.entries[line]
        assert self.existing is not None
        for a, b in {*zip(before.tolist(), after.tolist(), strict=True)}:
            if a == b:
                continue
            pair = (self.names[a], self.names[b])
            self.changed.add((line, *pair))
            self._expect(pair in entry.changes, f"{line} turns {pair[0]} into {pair[1]}")
            if pair[1] in entry.copies:
                at = worlds[(before == a) & (after == b) & alone]
                self._expect(bool(self.existing[at, b].all()), f"{line} makes {pair[1]} from nothing")

    def _moves(self, rule: Swap | Move, line: RuleLine, mask: Array, before: Array, after: Array) -> None:
        for dy, dx in footprint(rule):
            cells = reference.look(mask, (-dy, -dx))
            there = cells & (before != after)
            for number in np.unique(before[there]).tolist():
                self.moved.add((line, self.names[number]))
                self._expect(
                    self.names[number] in self.entries[line].moves, f"{line} moves {self.names[number]}"
                )

    def _overwrites(self, rule: Move, line: RuleLine, moment: Moment, masks: Any, before: Array) -> None:
        """Cells that something moves to and nothing leaves: what stood there is lost, `leaving` takes its number."""
        leaves = np.zeros(before.shape, bool)
        for other in moment.rules:
            if isinstance(other, Move):
                leaves |= masks[id(other)]
        dy, dx = rule.offset
        lost = reference.look(masks[id(rule)], (-dy, -dx)) & ~leaves
        assert rule.leaving is not None
        fresh = np.full(int(lost.sum()), rule.leaving.value)
        self._changes(line, before[lost], fresh, np.nonzero(lost)[0], np.ones(len(fresh), bool))

    def _meet(self, moment: Moment, pass_: Pass, wanted: Any) -> None:
        """Rules that claim one cell must be known to do so."""
        rules = [rule for rule in moment.rules if not isinstance(rule, Assign)]
        for i, second in enumerate(rules):
            for first in rules[:i]:
                lines = rule_line(first, pass_), rule_line(second, pass_)
                alike = isinstance(first, Transform) and isinstance(second, Transform)
                if alike and first.target == second.target:
                    continue
                claims = [self._claimed(rule, wanted[id(rule)]) for rule in (first, second)]
                if (claims[0] & claims[1]).any():
                    self.met.add(lines)
                    self._expect(lines in self.may_meet, f"{lines[0]} and {lines[1]} meet")

    def _write(self, moment: Moment, pass_: Pass, masks: Any) -> None:
        """Writes of one field of one cell whose order matters must be known to do so."""
        plain = [(rule, rule) for rule in moment.rules if isinstance(rule, Assign)]
        effects = [(e, rule) for rule in moment.rules if not isinstance(rule, Assign) for e in rule.effects]
        for writes in (plain, effects):
            cells = [reference.look(masks[id(rule)], (-w.offset[0], -w.offset[1])) for w, rule in writes]
            for i, (b, second) in enumerate(writes):
                for j, (a, first) in enumerate(writes[:i]):
                    if order_matters(a, b) and (cells[i] & cells[j]).any():
                        lines = rule_line(first, pass_), rule_line(second, pass_)
                        self.met.add(lines)
                        self._expect((*lines, a.field) in self.writes, f"{lines} write {a.field}")

    @staticmethod
    def _claimed(rule: Any, mask: Array) -> Array:
        cells = np.zeros(mask.shape, bool)
        for dy, dx in footprint(rule):
            cells |= reference.look(mask, (-dy, -dx))
        return cells

    def _expect(self, holds: bool, otherwise: str) -> None:
        if not holds and otherwise not in self.denied:
            self.denied.append(otherwise)
