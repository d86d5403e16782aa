"""Cuts statements into loops: which values are stored for later loops, and which are recomputed.

A loop over words reads flags of its own word; at neighbors it reads stored flags, or recomputes cheap ones.
A loop over cells reads floats and stored flags.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Literal

from powderdsl.ir.ops import FLAG, REAL, Node, Offset, ordered, walk
from powderdsl.schedule.costs import (
    ARITHMETIC,
    DRAWS,
    LOGIC,
    UNIFORM,
    Costs,
    asked_for,
    is_constant,
    movable,
    sources_of,
    stored_parts,
)
from powderdsl.schedule.floats import is_comparison, of_floats
from powderdsl.schedule.types import (
    ANSWER,
    Compute,
    Forget,
    Guard,
    Namer,
    Out,
    Schedule,
    Statement,
    Var,
    combined,
    conjuncts,
    flat,
    load,
    loaded,
)


def cut(costs: Costs) -> Callable[[Schedule], Schedule]:
    """The stage for a target: every `Compute` becomes loops over words and loops over cells.

    `p = f(a)[0,1] & b`, where f is costly → `loop words: t = f(a)`, `loop words: p = t[0,1] & b`.
    """

    def stage(schedule: Schedule) -> Schedule:
        cutter = Cutter(schedule, costs)
        body = cutter.block(schedule.body, top=True)
        leaves = tuple((slot, cutter.renamed(node)) for slot, node in schedule.leaves)
        return replace(schedule, body=tuple(body), leaves=leaves)

    return stage


# Loops


Pairs = Callable[[list[Node]], list[tuple[Var, Node]]]
"""Assigns variables to nodes that are to be stored."""


class Cutter:
    """Loops for targets where testing a mask costs a barrier and flags are computed word by word."""

    def __init__(self, schedule: Schedule, costs: Costs):
        self.namer, self.graph, self.costs = Namer(schedule), schedule.graph, costs
        self.known: dict[int, Var] = {}
        """The variables of the values stored so far, by the value's id."""
        self.statements: list[Statement] = []
        nodes = ordered(node for one in flat(schedule.body) for node in one.values())
        self.comparisons = [node for node in nodes if is_comparison(node)]
        offsets: dict[int, set[Offset]] = {}
        for node in nodes:
            for source, offset in sources_of(node):
                offsets.setdefault(id(source), set()).add(offset)
        self.askers = {key: len(found) for key, found in offsets.items()}
        """At how many neighbors each node is read."""
        shifted = [node.args[0] for node in nodes if node.op == "shift" and node.type == REAL]
        self.wanted = {
            id(part)
            for node in shifted
            for part in stored_parts(node, lambda node: node.op == "load", costs.floats)
            if part.op != "load"
        }
        """Floats that are read at neighbors later."""
        led = [node for node in nodes if node.op == "led"]
        self.led = {id(node.args[1]): node for node in led}
        self.same: dict[str, Node] = {}
        """For each variable that is only another name: the load of the variable that it names."""

        self.there = {var.name for _, var in schedule.finds}
        """The variables defined so far."""

    def emit(self, statement: Statement) -> None:
        self.statements.append(statement)
        self.there |= {var.name for var in statement.defined()}

    def alias(self, names: dict[str, Node]) -> None:
        """Note variables that are only other names of values."""
        self.same |= names
        self.there |= names.keys()

    def have(self, node: Node) -> bool:
        return node.op == "load" or id(node) in self.known

    def variable(self, node: Node) -> Node:
        """The load of a stored node."""
        found = node if node.op == "load" else load(self.graph, self.known[id(node)])
        return self.same.get(found.attr, found)

    def renamed(self, node: Node) -> Node:
        return self.variable(node) if node.op == "load" else node

    def kept(self, guard: Guard) -> tuple[tuple[Var, Node], ...]:
        return tuple((var, self.renamed(value)) for var, value in guard.keeps)

    # Statements

    def block(
        self, body: Sequence[Statement], kept: frozenset[str] = frozenset(), *, top: bool = False
    ) -> list[Statement]:
        """A block as loops. `kept`: names that the guard around the block keeps."""
        outer, self.statements = self.statements, []
        scope = dict(self.known), set(self.there)
        for i, statement in enumerate(body):
            match statement:
                case Compute(outs, place):
                    guard = body[i + 1] if i + 1 < len(body) else None
                    if top and (isinstance(guard, Guard) or all(out.var.type == FLAG for out in outs)):
                        self.hoist_comparisons([out.value for out in outs], place)
                    if isinstance(guard, Guard):
                        self.guarded(statement, guard)
                    else:
                        self.compute(outs, place, kept, statement.when)
                case Guard() if not (i and isinstance(body[i - 1], Compute)):
                    self.ask([], statement)
                case Guard():
                    pass  # emitted with the masks before it
                case Forget():
                    self.emit(statement)
                case _:
                    raise AssertionError("movements and buffers come after loops")
        found, self.statements = self.statements, outer
        if not top:
            self.known, self.there = scope
        return found

    def compute(
        self,
        outs: Iterable[Out],
        place: str,
        kept: frozenset[str] = frozenset(),
        when: Node | None = None,
    ) -> None:
        """Store values under the names of their variables. `when`: see `Compute`."""
        named = {id(out.value): out.var for out in reversed(list(outs)) if not self.have(out.value)}
        self.ensure([out.value for out in outs], place, named, when)
        for out in outs:
            if named.get(id(out.value)) is out.var:
                continue
            if out.var.name in kept:
                self.emit(Compute((Out(out.var, self.variable(out.value)),), place, "words"))
            else:  # stored under another name
                self.alias({out.var.name: self.variable(out.value)})

    def hoist_comparisons(self, masks: list[Node], place: str) -> None:
        """Compute the comparisons of masks before the guard, with all others that the same loop can compute."""
        asked = [
            self.led.get(id(node), node)
            for mask in masks
            for node in walk(mask)
            if is_comparison(node) and not self.have(node) and not self.have(self.led.get(id(node), node))
        ]
        if not asked:
            return
        asked = list(dict.fromkeys(asked))
        self.ensure([need for node in asked for need in self.needs(node)], place)
        others = [self.led.get(id(node), node) for node in self.comparisons]
        ready = [
            node
            for node in others
            if not self.have(node) and not self.needs(node) and self.there.issuperset(loaded([node]))
        ]
        self.ensure([*asked, *ready], place)

    def guarded(self, masks: Compute, guard: Guard) -> None:
        """Masks and the guard that tests them: the cheap parts first, the rest only if those hold somewhere."""
        graph, place = self.graph, masks.place
        self.alias({out.var.name: self.variable(out.value) for out in masks.outs if self.have(out.value)})
        masks = replace(masks, outs=tuple(out for out in masks.outs if out.var.name not in self.same))
        split = {out.var.name: self.split(out.value) for out in masks.outs}
        needs = [need for out in masks.outs for need in self.needs(out.value)]
        asked = {node.attr for node in guard.when if node.op == "load"}
        mine = [out for out in masks.outs if out.var.name in asked]
        if len(mine) < len(masks.outs):
            self.compute([out for out in masks.outs if out.var.name not in asked], place)
        lazy = [Out(out.var, self.lazily(*split[out.var.name])) for out in mine]
        cheap = {name: parts for name, (parts, _) in split.items()}
        if not needs or not all(cheap[out.var.name] for out in mine):
            self.ensure([need for out in lazy for need in self.needs(out.value)], place)
            self.ask(lazy, guard)
            return
        # The other parts, and what they need, are computed only if the cheap parts hold somewhere.
        first = [
            combined("and", cheap[node.attr], graph) if node.attr in cheap else node for node in guard.when
        ]
        outer, self.statements = self.statements, []
        scope = dict(self.known), set(self.there)
        self.ensure([need for out in lazy for need in self.needs(out.value)], place)
        self.ask(lazy, guard)
        inner, self.statements = self.statements, outer
        self.known, self.there = scope
        nothing = graph.node("const", FLAG, (), False)
        masked = {
            out.var.name for out in mine
        }  # a mask may be what a slot held before: nothing, where masks are skipped
        kept = tuple((var, nothing if value.attr in masked else value) for var, value in self.kept(guard))
        kept = (*((out.var, nothing) for out in mine), *kept)
        question = self.answer(first)
        self.emit(Compute((question,), place, "words"))
        when = (load(graph, question.var),)
        self.emit(Guard(when, tuple(inner), kept, guard.place))

    def ask(self, masks: list[Out], guard: Guard) -> None:
        """Store masks, test whether they hold anywhere, and emit the guard."""
        values = {out.var.name: out.value for out in masks}
        asked = [values.get(node.attr, node) if node.op == "load" else node for node in guard.when]
        self.ensure([need for node in asked for need in self.needs(node)], guard.place)
        words = tuple(Out(out.var, self.word(out.value)) for out in masks)
        question = self.answer(asked)
        self.emit(Compute((*words, question), guard.place, "words"))
        body = tuple(self.block(guard.body, frozenset(var.name for var, _ in guard.keeps)))
        when = (load(self.graph, question.var),)
        self.emit(Guard(when, body, self.kept(guard), guard.place))

    def answer(self, flags: Sequence[Node]) -> Out:
        """A new variable: whether one of some flags holds in any cell."""
        some = combined("or", [self.word(flag) for flag in flags], self.graph)
        return Out(self.namer.var(ANSWER), self.graph.node("any", ANSWER, (some,)))

    def split(self, mask: Node) -> tuple[list[Node], list[Node]]:
        """The conjuncts that one loop can compute from stored values, and the others."""
        cheap: list[Node] = []
        rest: list[Node] = []
        for part in conjuncts(mask):
            draws = any(self.is_costly(node) for node in walk(part)) and not self.have(part)
            more = (of_floats(part) and not self.have(part)) or self.needs(part)
            (rest if draws or more else cheap).append(part)
        return cheap, rest

    def is_costly(self, node: Node) -> bool:
        """Whether a draw is made only where a mask's other parts hold."""
        return node.op in DRAWS

    def lazily(self, cheap: list[Node], rest: list[Node]) -> Node:
        """The conjunction; the rest is computed only in words where the cheap parts hold somewhere."""
        if not rest or not cheap:
            return combined("and", [*cheap, *rest], self.graph)
        return self.under(combined("and", cheap, self.graph), rest)

    def under(self, first: Node, rest: list[Node]) -> Node:
        """A conjunction under a condition: draws come last, each conditional on everything before it."""
        value = first
        for part in sorted(rest, key=lambda part: part.op in DRAWS):
            if part.op in DRAWS and not self.have(part):
                part = asked_for(part, value, self.graph)
            value = combined("and", [value, part], self.graph)
        return self.graph.node("when", FLAG, (first, value))

    # What must be stored

    def needs(self, node: Node) -> list[Node]:
        """What must be stored before a node can be computed."""
        if self.have(node):
            return []
        return self.cell_needs(node) if of_floats(node) else self.word_needs(node)

    def again(self, node: Node) -> bool:
        """Whether a flag's value at a neighbor is stored or cheap to recompute."""
        most = max(1, self.costs.gates // max(1, self.askers.get(id(node), 1)))
        return self.have(node) or movable(node, self.have, most)

    def word_needs(self, node: Node) -> list[Node]:
        found: dict[int, Node] = {}
        seen: set[int] = set()
        stack = [node]
        while stack:
            top = stack.pop()
            if id(top) in seen or self.have(top) or top.op in UNIFORM:
                continue
            seen.add(id(top))
            if of_floats(top):
                found[id(top)] = top
                continue
            sources = {id(source): source for source, _ in sources_of(top)}
            for source in sources.values():
                if not self.again(source):
                    found[id(source)] = source
                else:
                    stack.append(source)
            stack.extend(arg for arg in top.args if id(arg) not in sources)
        return list(found.values())

    def cell_needs(self, node: Node) -> list[Node]:
        """The flags, then the floats, that a loop over cells reads."""
        found: dict[int, Node] = {}
        seen: set[int] = set()
        stack = [node]
        while stack:
            top = stack.pop()
            if id(top) in seen or (top is not node and self.have(top)):
                continue
            seen.add(id(top))
            if self.stands_apart(top, node):
                found[id(top)] = top
            elif top.op == "led":
                stack.extend(top.args)
            elif top.op == "select" and of_floats(top.args[0]) and not self.have(top.args[0]):
                found[id(top.args[0])] = top.args[0]  # choices read stored flags
                stack.extend(top.args[1:])
            elif top.type != REAL and top is not node and not is_comparison(top):
                if top.op != "param":
                    found[id(top)] = top
            elif top.op == "shift":
                source = top.args[0]
                if self.have(source):
                    continue
                parts = stored_parts(source, self.have, self.costs.floats) if top.attr[2] else [source]
                found |= {id(part): part for part in parts}
                if not parts:
                    stack.append(source)
            else:
                stack.extend(top.args)
        return sorted(found.values(), key=lambda need: need.type == REAL)

    def stands_apart(self, part: Node, node: Node) -> bool:
        """Whether a part of a node has a loop of its own before the node's loop."""
        return False

    def ensure(
        self,
        nodes: Iterable[Node],
        place: str,
        named: dict[int, Var] | None = None,
        when: Node | None = None,
    ) -> None:
        """Store nodes, after everything that they need. `when`: see `Compute`."""
        named = named or {}
        wanted = [
            node
            for node in dict.fromkeys(nodes)
            if not self.have(node) and not (node.op in UNIFORM and node.type == REAL)
        ]
        if not wanted:
            return
        before = [
            need
            for need in dict.fromkeys(n for node in wanted for n in self.needs(node))
            if not self.have(need)
        ]
        if before:
            self.ensure(before, place, named)
            self.ensure(wanted, place, named, when)
            return
        floats = [node for node in wanted if of_floats(node)]
        # Floats that are read at neighbors later are stored here, where they are computed anyway.
        floats += [i for node in floats for i in walk(node) if id(i) in self.wanted and not self.have(i)]
        flags = [node for node in wanted if node not in floats]

        def pairs(nodes: list[Node]) -> list[tuple[Var, Node]]:
            return [(named.get(id(node)) or self.namer.var(node.type), node) for node in nodes]

        self.store(list(dict.fromkeys(floats)), flags, pairs, place, when)

    def store(
        self, floats: list[Node], flags: list[Node], pairs: Pairs, place: str, when: Node | None
    ) -> None:
        """Loops for nodes whose inputs are all stored."""
        if floats:
            self.cells(pairs(floats), place)
        if flags:
            self.words(pairs(flags), place, when)

    def words(self, pairs: Sequence[tuple[Var, Node]], place: str, when: Node | None = None) -> None:
        outs = tuple(Out(var, self.word(node)) for var, node in pairs)
        self.emit(Compute(outs, place, "words", when=when))
        self.known |= {id(node): var for var, node in pairs if not self.have(node)}

    def cells(
        self,
        pairs: Sequence[tuple[Var, Node]],
        place: str,
        over: Literal["cells", "choices"] = "cells",
    ) -> None:
        """A loop over cells: floats first, then comparisons, each after the one under which it is computed."""
        pairs = sorted(pairs, key=lambda pair: (pair[1].type != REAL, pair[1].op == "led"))
        cells = _Cells(self)
        outs = tuple(Out(var, cells.value(node)) for var, node in pairs)
        self.emit(Compute(outs, place, over))
        self.known |= {id(node): var for var, node in pairs}

    # Values of a loop

    def word(self, root: Node) -> Node:
        """A flag in a loop over words; only variables are read at neighbors."""
        memo: dict[tuple[int, int, int], Node] = {}
        graph = self.graph

        def value(node: Node, dy: int = 0, dx: int = 0) -> Node:
            key = (id(node), dy, dx)
            if key not in memo:
                memo[key] = compute(node, dy, dx)
            return memo[key]

        def compute(node: Node, dy: int, dx: int) -> Node:
            if self.have(node):
                found = self.variable(node)
                return graph.node("shift", FLAG, (found,), (dy, dx, True)) if (dy, dx) != (0, 0) else found
            if is_constant(node):
                return node
            if node.op == "shift":
                sy, sx, wraps = node.attr
                if not wraps and self.have(node.args[0]):
                    assert dy == dx == 0
                    return graph.node("shift", FLAG, (self.variable(node.args[0]),), node.attr)
                moved = value(node.args[0], dy + sy, dx + sx)
                if wraps:
                    return moved
                assert dy == dx == 0
                inside = graph.node("inside", FLAG, (), (sy, sx))
                return graph.node("and", FLAG, (moved, inside))
            if node.op in LOGIC:
                return graph.node(node.op, FLAG, tuple(value(arg, dy, dx) for arg in node.args))
            assert dy == dx == 0
            if node.op in ("swap", "arrive"):
                content, movers, rest = node.args
                sy, sx = node.attr
                arriving = (value(movers, -sy, -sx), value(content, -sy, -sx), value(rest))
                found = graph.node("select", FLAG, arriving)
                if node.op == "swap":
                    found = graph.node("select", FLAG, (value(movers), value(content, sy, sx), found))
                return found
            return graph.node(node.op, FLAG, tuple(value(arg) for arg in node.args), node.attr, node.places)

        return value(root)


class _Cells:
    """Values of one loop over cells; floats at neighbors are read from variables or recomputed."""

    def __init__(self, cutter: Cutter):
        self.cutter, self.graph = cutter, cutter.graph
        self.memo: dict[tuple[int, int, int], Node] = {}

    def value(self, node: Node, dy: int = 0, dx: int = 0) -> Node:
        key = (id(node), dy, dx)
        if key not in self.memo:
            self.memo[key] = self.compute(node, dy, dx)
        return self.memo[key]

    def compute(self, node: Node, dy: int, dx: int) -> Node:
        graph = self.graph
        if self.cutter.have(node):
            found = self.cutter.variable(node)
            return graph.node("shift", node.type, (found,), (dy, dx, True)) if (dy, dx) != (0, 0) else found
        if node.op in ("const", "param"):
            return node
        if node.op == "shift":
            sy, sx, wraps = node.attr
            if wraps:
                return self.value(node.args[0], dy + sy, dx + sx)
            assert dy == dx == 0
            return graph.node("shift", REAL, (self.cutter.variable(node.args[0]),), node.attr)
        assert dy == dx == 0 or node.op in ARITHMETIC
        args = tuple(self.value(arg, dy, dx) for arg in node.args)
        return graph.node(node.op, node.type, args, node.attr, node.places)
