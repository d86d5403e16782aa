"""The checked model -> IR. Vectors become two slots, fresh cells their parts, conflict policies masks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from powderdsl.analysis.changes import facts_of
from powderdsl.ir.build import Builder
from powderdsl.ir.lower.expressions import Inputs, Pair, lower_expression, node
from powderdsl.ir.ops import (
    FLAG,
    REAL,
    Graph,
    Node,
    PassGraph,
    Program,
    SlotType,
    SubstepGraph,
    Type,
    component_names,
    component_of,
    integer,
)
from powderdsl.model.logic.satisfy import Budget, Facts, satisfiable
from powderdsl.model.state import Slot, scratch_slots, slots
from powderdsl.model.types import Assign, Kind, Moment, Move, Pass, Ruleset, Swap, Transform

Mover = Transform | Swap | Move

LIVE_BUDGET = 100_000
"""Nodes evaluated to find rules that no world lets happen, a tenth of a second. After that every rule stays."""


def slot_names(slot: Slot) -> tuple[str, ...]:
    """The IR slots of a state array: one, or one for each component of a vector."""
    return _parts_of(slot.name, slot.kind)


def _parts_of(name: str, kind: Kind) -> tuple[str, ...]:
    return component_names(name) if kind.name == "vec2" else (name,)


def ir_type(kind: Kind, ids: int) -> Type:
    """The IR type in which values of a kind are held; `ids` is the number of element ids."""
    match kind.name:
        case "flag":
            return FLAG
        case "real" | "vec2":
            return REAL
        case "element":
            return integer(0, ids - 1)
        case "direction":
            return integer(0, 7)
    return integer(int(kind.lo), int(kind.hi))


def lower_ruleset(ruleset: Ruleset) -> Program:
    """All passes of a ruleset, one graph each."""
    slot_types = []
    for slot in slots(ruleset):
        names = slot_names(slot)
        for i, name in enumerate(names):
            default = slot.default[i] if isinstance(slot.default, tuple) else slot.default
            type, component = ir_type(slot.kind, ruleset.slots), i if len(names) > 1 else None
            slot_types.append(SlotType(name, type, default, slot.resets, slot.name, component))
    # The range of a slot that starts each step at its default grows from pass to pass.
    ranges = {
        s.name: integer(int(s.default), int(s.default))
        for s in slot_types
        if s.resets and s.type.name == "int"
    }
    passes = []
    for pass_ in live_passes(ruleset):
        graph = _PassLowering(ruleset, Graph(), ranges).lower(pass_)
        for name, last in graph.outputs:
            if name in ranges:
                ranges[name] = integer(min(ranges[name].lo, last.type.lo), max(ranges[name].hi, last.type.hi))
        passes.append(graph)
    return Program(
        ruleset.name,
        tuple(slot_types),
        tuple((p.name, p.kind.name) for p in ruleset.params),
        tuple((s.name, s.ident, s.bits) for s in ruleset.streams),
        tuple(passes),
    )


def live_passes(ruleset: Ruleset) -> tuple[Pass, ...]:
    """The passes without rules whose conditions cannot hold: a loop writes many copies, of which few suit the elements."""
    facts = replace(facts_of(ruleset), budget=Budget(LIVE_BUDGET))
    return tuple(
        replace(one, moments=tuple(_live_substep(moment, facts) for moment in one.moments))
        for one in ruleset.passes
    )


def _live_substep(moment: Moment, facts: Facts) -> Moment:
    lets = {let.name: let.value for let in moment.lets}
    rules = (
        rule for rule in moment.rules if rule.mask is None or satisfiable(facts, [(rule.mask, (0, 0))], lets)
    )
    return replace(moment, rules=tuple(rules))


def lower_pass(ruleset: Ruleset, pass_: Pass, graph: Graph) -> dict[str, Node]:
    """The nodes of the slots that a pass writes, in a graph that several passes may share."""
    return dict(_PassLowering(ruleset, graph).lower(pass_).outputs)


def lower_substep(ruleset: Ruleset, pass_: Pass, number: int, graph: Graph) -> dict[str, Node]:
    """The nodes of what one substep of a pass writes, as functions of the world that the substep finds.

    Scratch fields and values that `let` fixed in earlier substeps are inputs too, the latter as ``let NAME``; values
    that this substep fixes are among the results.
    """
    lowering = _PassLowering(ruleset, graph)
    build = lowering.build
    scratch = scratch_slots(pass_)
    lowering.slots |= scratch
    for slot in scratch.values():
        for name in slot_names(slot):
            lowering.state[name] = build.input(name, ir_type(slot.kind, ruleset.slots))
    for moment in pass_.moments[:number]:
        for let in moment.lets:
            type = REAL if let.value.kind.name == "chance" else ir_type(let.value.kind, ruleset.slots)
            parts = tuple(build.input(f"let {name}", type) for name in _parts_of(let.name, let.value.kind))
            lowering.lets[let.name] = parts[0] if len(parts) == 1 else (parts[0], parts[1])
    before = dict(lowering.state)
    moment = pass_.moments[number]
    lowering.substep(moment)
    found = {name: node for name, node in lowering.state.items() if before[name] is not node}
    for let in moment.lets:
        names = _parts_of(let.name, let.value.kind)
        parts = _parts(lowering.lets[let.name])
        found |= {f"let {name}": part for name, part in zip(names, parts, strict=True)}
    return found


class _PassLowering:
    """Lowers one pass: keeps the current node of every slot, and the values of lets."""

    def __init__(self, ruleset: Ruleset, graph: Graph, ranges: Mapping[str, Type] | None = None):
        self.ruleset = ruleset
        self.build = Builder(graph)
        self.slots = {slot.name: slot for slot in slots(ruleset)}
        """The state's arrays, and scratch fields."""
        types = {
            name: ir_type(slot.kind, ruleset.slots)
            for slot in self.slots.values()
            for name in slot_names(slot)
        } | dict(ranges or {})
        self.state = {name: self.build.input(name, type) for name, type in types.items()}
        self.lets: dict[str, Node | Pair] = {}

    def lower(self, pass_: Pass) -> PassGraph:
        build = self.build
        found = dict(self.state)
        scratch = scratch_slots(pass_)
        self.slots |= scratch
        for slot in scratch.values():
            # The number nearest to zero: the same in both components of a vector.
            default = slot.default[0] if isinstance(slot.default, tuple) else slot.default
            for name in slot_names(slot):
                self.state[name] = build.const(default, ir_type(slot.kind, self.ruleset.slots))
        substeps = tuple(self.substep(moment) for moment in pass_.moments)
        outputs = []
        for name, before in found.items():
            last = self.state[name]
            if last is before:
                continue
            if before.type == REAL:
                kind = self.slots[component_of(name)[0]].kind
                last = build.make("settle", REAL, last, attr=(float(kind.lo), float(kind.hi)))
            outputs.append((name, last))
        return PassGraph(pass_.name, pass_.pack, substeps, tuple(outputs))

    def inputs(self) -> Inputs:
        return Inputs(self.ruleset, self.build, dict(self.state), self.lets)

    def substep(self, moment: Moment) -> SubstepGraph:
        build = self.build
        place = next((f"{r.span.source.name}:{r.span.line}" for r in moment.rules), "")
        build.place = place
        for let in moment.lets:
            self.lets[let.name] = lower_expression(let.value, self.inputs())
        at = self.inputs()
        masks = {id(rule): node(rule.mask, at) for rule in moment.rules if rule.mask is not None}
        movers: list[Mover] = [rule for rule in moment.rules if not isinstance(rule, Assign)]
        if moment.policy in ("drop_both", "first_wins"):
            self._apply_policy(moment.policy, movers, masks)
        writes = [(rule, masks[id(rule)]) for rule in moment.rules if isinstance(rule, Assign)]
        effects = [(effect, masks[id(rule)]) for rule in movers for effect in rule.effects]
        values = {id(write): lower_expression(write.value, at) for write, _ in (*writes, *effects)}
        before = dict(self.state)
        for write, mask in writes:
            self._assign(write, values[id(write)], mask)
        self._move(movers, masks, at, moment.policy)
        for write, mask in effects:
            self._assign(write, values[id(write)], mask)
        changed = tuple((name, new) for name, new in self.state.items() if before[name] is not new)
        return SubstepGraph(moment.label, place, changed, tuple(masks.values()))

    def _assign(self, write: Assign, value: Node | Pair, mask: Node) -> None:
        """`field op value` at an offset from each cell of the mask, read from the target's side."""
        build = self.build
        slot = self.slots[write.field]
        back = (-write.offset[0], -write.offset[1])
        mask = build.shift(mask, back)
        if slot.of is not None:  # cells of other elements keep reading the default
            mask = build.and_(mask, build.in_set(self.state["element"], slot.of))
        for name, part in zip(slot_names(slot), _parts(value), strict=True):
            old = self.state[name]
            new = build.shift(part, back)
            if write.op != ":=":
                new = build.derive("add" if write.op == "+=" else "sub", old, new)
            if slot.kind.name == "int":
                new = build.clamp(new, int(slot.kind.lo), int(slot.kind.hi))
            self.state[name] = build.select(mask, new, old)

    def _move(self, movers: list[Mover], masks: dict[int, Node], at: Inputs, policy: str) -> None:
        """Transforms and what moves leave behind first, then arrivals, all from the world before.

        Without a policy that keeps them apart, a cell may take part in several exchanges. They are then not swaps, of
        which each cell belongs to one at most: movers take what their targets held, and what they held arrives there.
        """
        build = self.build
        before = dict(self.state)
        travelling = [name for slot in self.slots.values() if slot.travels for name in slot_names(slot)]
        for rule in movers:
            if isinstance(rule, Swap):
                continue
            target = rule.target if isinstance(rule, Transform) else rule.leaving
            left = (
                {name: build.shift(before[name], rule.offset) for name in travelling}
                if target is None and isinstance(rule, Move)
                else self._fresh(node(target, at))  # type: ignore[arg-type]  # only moves may have none
            )
            for name, value in left.items():
                self.state[name] = build.select(masks[id(rule)], value, self.state[name])
        for rule in movers:
            if isinstance(rule, Transform):
                continue
            swaps = isinstance(rule, Swap)
            op = "swap" if swaps and policy != "overwrite" else "arrive"
            for name in travelling:
                mask, rest = masks[id(rule)], self.state[name]
                moved = build.derive(op, before[name], mask, rest, attr=rule.offset)
                if swaps and op == "arrive":
                    moved = build.select(mask, build.shift(before[name], rule.offset), moved)
                self.state[name] = moved

    def _fresh(self, element: Node) -> dict[str, Node]:
        """What a new cell of an element holds."""
        build = self.build
        at = self.inputs()
        found = {"element": element}
        for slot in self.slots.values():
            if not slot.travels or slot.name == "element":
                continue
            prop = self.ruleset.property(slot.name)
            if prop is not None:
                found[slot.name] = at.property_of(prop, element)
                continue
            defaults = slot.default if isinstance(slot.default, tuple) else (slot.default,)
            type = ir_type(slot.kind, self.ruleset.slots)
            for part, (name, default) in enumerate(zip(slot_names(slot), defaults, strict=True)):
                values = [build.const(default, type)] * self.ruleset.slots
                for identity, own in slot.own:
                    values[identity] = build.const(own[part] if isinstance(own, tuple) else own, type)
                found[name] = at.by_element(element, values)
        return found

    def _apply_policy(self, policy: str, movers: list[Mover], masks: dict[int, Node]) -> None:
        """Narrow the masks so that no two rules claim one cell."""
        build = self.build
        wanted = {id(rule): masks[id(rule)] for rule in movers}

        def claimed(rule: Mover, mask: Node) -> Node:
            if isinstance(rule, Transform):
                return mask
            return build.or_(mask, build.shift(mask, (-rule.offset[0], -rule.offset[1])))

        def touches(rule: Mover, cells: Node) -> Node:
            return cells if isinstance(rule, Transform) else build.or_(cells, build.shift(cells, rule.offset))

        taken = build.flag(False)
        for rule in movers:
            mask = wanted[id(rule)]
            if isinstance(rule, Swap) or (isinstance(rule, Move) and rule.leaving is not None):
                dy, dx = rule.offset
                chained = build.or_(build.shift(mask, (dy, dx)), build.shift(mask, (-dy, -dx)))
                mask = build.and_(mask, build.not_(chained))
            if policy == "drop_both":
                for other in movers:
                    if other is not rule:
                        mask = build.and_(mask, build.not_(touches(rule, claimed(other, wanted[id(other)]))))
            else:
                mask = build.and_(mask, build.not_(touches(rule, taken)))
                taken = build.or_(taken, claimed(rule, mask))
            masks[id(rule)] = mask


def _parts(value: Node | Pair) -> tuple[Node, ...]:
    return (value,) if isinstance(value, Node) else value
