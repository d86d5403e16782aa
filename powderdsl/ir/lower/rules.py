"""The checked model -> IR. Vectors become two planes, fresh cells their parts, conflict policies masks."""

from __future__ import annotations

from dataclasses import dataclass, field

from powderdsl.ir.build import Builder
from powderdsl.ir.lower.expressions import Pair, Planes, lower_expression
from powderdsl.ir.lower.live import live_passes
from powderdsl.ir.ops import (
    FLAG,
    REAL,
    Graph,
    Node,
    PassGraph,
    Program,
    SlotType,
    Step,
    Type,
    component_names,
    whole,
)
from powderdsl.model.state import Slot, slots
from powderdsl.model.types import Assign, Kind, Moment, Move, Pass, Ruleset, Swap, Transform

Mover = Transform | Swap | Move


def plane_names(slot: Slot) -> tuple[str, ...]:
    """The IR slots of a state slot."""
    return component_names(slot.name) if slot.planes == 2 else (slot.name,)


def plane_type(kind: Kind, ids: int) -> Type:
    """The IR type in which values of a kind are held."""
    match kind.name:
        case "flag":
            return FLAG
        case "real" | "vec2":
            return REAL
        case "element":
            return whole(0, ids - 1)
        case "direction":
            return whole(0, 7)
    return whole(int(kind.lo), int(kind.hi))


def lower_ruleset(ruleset: Ruleset) -> Program:
    """All passes of a ruleset, one graph each."""
    table = {slot.name: slot for slot in slots(ruleset)}
    slot_types = []
    for slot in table.values():
        defaults = slot.default if isinstance(slot.default, tuple) else (slot.default,)
        type, names = plane_type(slot.kind, ruleset.slots), plane_names(slot)
        for i, (name, default) in enumerate(zip(names, defaults, strict=True)):
            component = i if len(names) > 1 else None
            slot_types.append(SlotType(name, type, default, slot.resets, slot.name, component))
    # What a slot that starts each step at its default can have become by the time a pass reads it.
    ranges = {
        s.name: whole(int(s.default), int(s.default)) for s in slot_types if s.resets and s.type.name == "int"
    }
    passes = []
    for pass_ in live_passes(ruleset):
        graph = _PassLowering(ruleset, table, {s.name: s.type for s in slot_types} | ranges).lower(pass_)
        for name, node in graph.outputs:
            if name in ranges:
                ranges[name] = whole(min(ranges[name].lo, node.type.lo), max(ranges[name].hi, node.type.hi))
        passes.append(graph)
    return Program(
        ruleset.name,
        tuple(slot_types),
        tuple((p.name, p.kind.name) for p in ruleset.params),
        tuple((s.name, s.ident, s.bits) for s in ruleset.streams),
        tuple(passes),
    )


def lower_pass(ruleset: Ruleset, pass_: Pass, graph: Graph) -> dict[str, Node]:
    """What a pass leaves in the slots that it writes, as nodes of a graph that several passes may share."""
    return dict(_pass_lowering(ruleset, graph).lower(pass_).outputs)


def lower_moment(ruleset: Ruleset, pass_: Pass, number: int, graph: Graph) -> dict[str, Node]:
    """What one moment of a pass leaves, as nodes that read the world as the moment finds it.

    Scratch fields and values that `let` fixed in earlier moments are inputs too, the latter as ``let NAME``; values
    that this moment fixes are among the results.
    """
    lowering = _pass_lowering(ruleset, graph)
    build = lowering.build
    lowering.slots = dict(lowering.table)
    for item in pass_.scratch:
        planes = 2 if item.kind.name == "vec2" else 1
        slot = Slot(item.name, item.kind, item.default, False, True, None, "", planes)
        lowering.slots[item.name] = slot
        lowering.types |= dict.fromkeys(plane_names(slot), plane_type(item.kind, ruleset.slots))
    lowering.state = {name: build.input(name, type) for name, type in lowering.types.items()}
    lowering.lets = {}
    for moment in pass_.moments[:number]:
        for let in moment.lets:
            type = REAL if let.value.kind.name == "chance" else plane_type(let.value.kind, ruleset.slots)
            parts = tuple(build.input(f"let {name}", type) for name in _part_names(let.name, let.value.kind))
            lowering.lets[let.name] = parts[0] if len(parts) == 1 else (parts[0], parts[1])
    before = dict(lowering.state)
    moment = pass_.moments[number]
    lowering._moment(moment, pass_)
    found = {name: node for name, node in lowering.state.items() if before[name] is not node}
    for let in moment.lets:
        names = _part_names(let.name, let.value.kind)
        found |= {
            f"let {name}": part for name, part in zip(names, _parts(lowering.lets[let.name]), strict=True)
        }
    return found


def _part_names(name: str, kind: Kind) -> tuple[str, ...]:
    return component_names(name) if kind.name == "vec2" else (name,)


def _pass_lowering(ruleset: Ruleset, graph: Graph) -> _PassLowering:
    table = {slot.name: slot for slot in slots(ruleset)}
    types = {
        name: plane_type(slot.kind, ruleset.slots) for slot in table.values() for name in plane_names(slot)
    }
    return _PassLowering(ruleset, table, types, Builder(graph))


@dataclass
class _PassLowering:
    """Lowers one pass: keeps the current node of every slot, and the values of lets."""

    ruleset: Ruleset
    table: dict[str, Slot]
    types: dict[str, Type]
    build: Builder = field(default_factory=Builder)

    def lower(self, pass_: Pass) -> PassGraph:
        build = self.build
        self.state: dict[str, Node] = {name: build.input(name, type) for name, type in self.types.items()}
        self.lets: dict[str, Node | Pair] = {}
        self.slots = dict(self.table)
        for item in pass_.scratch:
            slot = Slot(
                item.name,
                item.kind,
                item.default,
                False,
                True,
                None,
                "",
                2 if item.kind.name == "vec2" else 1,
            )
            self.slots[item.name] = slot
            type = plane_type(item.kind, self.ruleset.slots)
            for name in plane_names(slot):
                # The nearest number to zero: the same in both parts of a vector.
                default = item.default[0] if isinstance(item.default, tuple) else item.default
                self.state[name] = build.const(default, type)
        steps = tuple(self._moment(moment, pass_) for moment in pass_.moments)
        outputs = []
        for name, type in self.types.items():
            if self.state[name].op == "input" and self.state[name].attr == name:
                continue
            if type == REAL:
                kind = self.table[name.removesuffix(".row").removesuffix(".column")].kind
                self.state[name] = build.make(
                    "settle", REAL, self.state[name], attr=(float(kind.lo), float(kind.hi))
                )
            outputs.append((name, self.state[name]))
        return PassGraph(pass_.name, pass_.pack, steps, tuple(outputs))

    def planes(self) -> Planes:
        return Planes(self.ruleset, self.build, dict(self.state), self.lets, self.slots)

    def _moment(self, moment: Moment, pass_: Pass) -> Step:
        build = self.build
        place = next((f"{r.span.source.name}:{r.span.line}" for r in moment.rules), "")
        build.place = place
        for let in moment.lets:
            self.lets[let.name] = lower_expression(let.value, self.planes())
        at = self.planes()
        masks = {
            id(rule): _flag(lower_expression(rule.mask, at)) for rule in moment.rules if rule.mask is not None
        }
        movers: list[Mover] = [rule for rule in moment.rules if not isinstance(rule, Assign)]
        if moment.policy != "prove":
            self._apply_policy(moment.policy, movers, masks)
        writes = [(rule, masks[id(rule)]) for rule in moment.rules if isinstance(rule, Assign)]
        effects = [(effect, masks[id(rule)]) for rule in movers for effect in rule.effects]
        values = {id(write): lower_expression(write.value, at) for write, _ in (*writes, *effects)}
        before = dict(self.state)
        for write, mask in writes:
            self._assign(write, values[id(write)], mask)
        self._move(movers, masks, at)
        for write, mask in effects:
            self._assign(write, values[id(write)], mask)
        changed = tuple((name, node) for name, node in self.state.items() if before.get(name) is not node)
        return Step(moment.label, place, changed, tuple(masks.values()))

    def _assign(self, write: Assign, value: Node | Pair, mask: Node) -> None:
        """`field op value` at an offset from each cell of the mask, read from the target's side."""
        build = self.build
        slot = self.slots[write.field]
        back = (-write.offset[0], -write.offset[1])
        mask = build.shift(mask, back)
        if slot.of is not None:  # cells of other elements keep reading the default
            mask = build.and_(mask, build.in_set(self.state["element"], slot.of))
        for name, part in zip(plane_names(slot), _parts(value), strict=True):
            old = self.state[name]
            new = build.shift(part, back)
            if write.op != ":=":
                new = build.arithmetic("add" if write.op == "+=" else "sub", old, new)
            if slot.kind.name == "int":
                new = build.clamp(new, int(slot.kind.lo), int(slot.kind.hi))
            self.state[name] = build.select(mask, new, old)

    def _move(self, movers: list[Mover], masks: dict[int, Node], at: Planes) -> None:
        """Transforms and what moves leave behind first, then arrivals, all from the world before."""
        build = self.build
        before = dict(self.state)
        for rule in movers:
            target = (
                rule.target
                if isinstance(rule, Transform)
                else rule.leaving
                if isinstance(rule, Move)
                else None
            )
            if target is not None:
                fresh = lower_expression(target, at)
                assert isinstance(fresh, Node)
                for name, node in self._fresh(fresh).items():
                    self.state[name] = build.select(masks[id(rule)], node, self.state[name])
        for rule in movers:
            if isinstance(rule, Transform):
                continue
            move = build.swap if isinstance(rule, Swap) else build.arrive
            for slot in self.slots.values():
                if slot.travels:
                    for name in plane_names(slot):
                        self.state[name] = move(before[name], masks[id(rule)], self.state[name], rule.offset)

    def _fresh(self, element: Node) -> dict[str, Node]:
        """What a new cell of an element holds."""
        build = self.build
        at = self.planes()
        found = {"element": element}
        for slot in self.slots.values():
            if not slot.travels or slot.name == "element":
                continue
            prop = self.ruleset.property(slot.name)
            if prop is not None:
                found[slot.name] = at.property_of(prop, element)
                continue
            defaults = slot.default if isinstance(slot.default, tuple) else (slot.default,)
            type = plane_type(slot.kind, self.ruleset.slots)
            for part, (name, default) in enumerate(zip(plane_names(slot), defaults, strict=True)):
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
            if not isinstance(rule, Transform):
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


def _flag(value: Node | Pair) -> Node:
    assert isinstance(value, Node)
    return value


def _parts(value: Node | Pair) -> tuple[Node, ...]:
    return (value,) if isinstance(value, Node) else value
