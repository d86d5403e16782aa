"""Cuts statements into loops: decides which values are stored for later loops, and which are recomputed.

A loop over words reads flags of its own word; at neighbors it reads stored flags, or recomputes cheap ones.
A loop over cells reads floats and stored flags.

Some targets process whole planes `by_rows` and track which planes are empty, so testing a mask is free. Movements are
operations on whole planes, in place where a substep only moves them. Long chains of choices are applied to a field one
after another.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from typing import Literal

from powderdsl.ir.ops import FLAG, REAL, Node, Offset, conjunctions, conjuncts, needed, ordered, taken, walk
from powderdsl.schedule.costs import (
    DRAWS,
    UNIFORM,
    Costs,
    draw_under,
    gate_cost,
    is_coin,
    is_constant,
    is_recomputable,
    sources_of,
    stored_parts,
)
from powderdsl.schedule.floats import is_comparison, match_slot_choices, of_floats
from powderdsl.schedule.types import (
    ANSWER,
    Block,
    Compute,
    Forget,
    Guard,
    Move,
    Namer,
    Out,
    Schedule,
    Statement,
    Var,
    combined,
    connected,
    is_movement,
    leftover,
    load,
    map_values,
)

ONLY_READER = 4
"""Extra gates that are recomputed for a single reader: about the cost of a loop that stores a plane."""

FEWEST = 3
"""The shortest chain of choices that is worth its own field."""


def cut(schedule: Schedule, costs: Costs) -> Schedule:
    """Cut every `Compute` into loops over words and loops over cells, by the costs on a target.

    `p = f(a)[0,1] & b`, where f is costly → `loop words: t = f(a)`, `loop words: p = t[0,1] & b`.
    """
    cutter = _Cutter(schedule, costs)
    loops = replace(schedule, body=cutter.block(schedule.body, top=True))
    return map_values(loops, lambda node: cutter.aliases.get(node.attr)) if cutter.aliases else loops


class _Cutter:
    def __init__(self, schedule: Schedule, costs: Costs):
        self.namer, self.graph, self.costs = Namer(schedule), schedule.graph, costs
        self.statements: list[Statement] = []
        self.stored: dict[Node, Var] = {}
        """The variables of the values stored so far."""
        self.input_slots = schedule.input_slots
        self.defined = set(self.input_slots)
        """The variables defined so far."""
        self.aliases: dict[str, Node] = {}
        """For each variable that is only another name: the load of the variable that it names."""
        self.comparisons: dict[Node, Node] = {}
        """The node to compute for each comparison: the comparison, or a `led` node that has it as its second argument."""
        self.read_at_neighbors: set[Node] = set()
        """Floats that are read at neighbors later."""
        sources: dict[tuple[Node, Offset], None] = {}
        for node in ordered(schedule.values):
            sources |= dict.fromkeys(sources_of(node))
            if is_comparison(node):
                self.comparisons[node] = node
            elif node.op == "led":
                self.comparisons[node.args[1]] = node
            elif node.op == "shift" and node.type == REAL:
                self.read_at_neighbors.update(stored_parts(node.args[0], self.is_stored, costs.floats))
        self.readers = Counter(source for source, _ in sources)
        """The number of neighbors at which each node is read."""
        self.shared: Counter[Node] = Counter()
        """The number of masks that contain each conjunct: if its plane is empty, so are all these masks."""
        for masks, guard in pairwise(schedule.body):
            if isinstance(masks, Compute) and isinstance(guard, Guard):
                tested = {node.attr for node in guard.when.args}
                values = [out.value for out in masks.outs if out.var.name in tested]
                self.shared.update({part for value in values for part in conjunctions(value)})
        self.split_masks: dict[Node, Node] = {}
        """Masks whose first parts are stored: the stored parts and the rest."""

    def emit(self, statement: Statement) -> None:
        self.statements.append(statement)
        self.defined.update(statement.vars)

    @contextmanager
    def inner(self) -> Iterator[list[Statement]]:
        """Collect the statements of a nested block. Values stored inside are not available after the block."""
        outer = self.statements, self.stored, self.defined
        self.statements, self.stored, self.defined = [], dict(self.stored), set(self.defined)
        yield self.statements
        self.statements, self.stored, self.defined = outer

    def is_stored(self, node: Node) -> bool:
        return node.op == "load" or node in self.stored

    def variable(self, node: Node) -> Node:
        """The load of a stored node."""
        stored = node if node.op == "load" else load(self.graph, self.stored[node])
        return self.aliases.get(stored.attr, stored)

    def guard(self, when: Node, body: Iterable[Statement], olds: dict[Var, Node], place: str) -> None:
        """Emit statements that run only if an answer is true, and the values of variables if it is not."""
        outs = tuple([Out(var, old, old) for var, old in olds.items()])
        self.emit(Guard(outs, place, when=when, body=tuple(body)))

    # Statements

    def block(self, body: Block, *, top: bool = False) -> Block:
        with self.inner() as statements:
            for before, statement, after in zip((None, *body), body, (*body[1:], None), strict=False):
                if isinstance(statement, Guard):
                    masks = before if isinstance(before, Compute) else Compute((), statement.place)
                    self.cut_guard(masks, statement)
                elif isinstance(statement, Compute):
                    is_mask = isinstance(after, Guard)
                    if top and (is_mask or all(out.var.type == FLAG for out in statement.outs)):
                        self.hoist_comparisons(statement)
                    if not is_mask:
                        self.compute(statement)
                else:
                    self.emit(statement)
        return tuple(statements)

    def compute(self, loop: Compute) -> None:
        """Store values under the names of their variables."""
        named = {out.value: out.var for out in reversed(loop.outs) if not self.is_stored(out.value)}
        self.ensure(loop.results, loop.place, named, loop.when)
        for out in loop.outs:
            if named.get(out.value) is not out.var:
                copy = replace(out, value=self.variable(out.value))
                self.emit(Compute((copy,), loop.place, over="words"))

    def hoist_comparisons(self, masks: Compute) -> None:
        """Compute the comparisons of masks before the guard."""
        missing: list[Node] = []
        for node in (node for value in masks.results for node in walk(value) if is_comparison(node)):
            if not self.is_stored(node) and not self.is_stored(self.comparisons[node]):
                missing.append(self.comparisons[node])
        self.ensure(missing, masks.place)

    # Masks and guards

    def cut_guard(self, masks: Compute, guard: Guard) -> None:
        """Masks and the guard that tests them: the cheap parts first, the rest only if the cheap parts hold somewhere."""
        by_rows, graph, place = self.costs.by_rows, self.graph, masks.place
        if by_rows:
            self.ensure([part for value in masks.results for part in self.shared_parts(value)], place)
        vars: dict[Node, Var] = {}
        for out in masks.outs:
            # A mask may be stored under another name, or be a shared part itself.
            if self.is_stored(out.value):
                self.aliases[out.var.name] = self.variable(out.value)
            elif vars.setdefault(out.value, out.var) is not out.var:
                self.aliases[out.var.name] = load(graph, vars[out.value])
        self.defined.update(self.aliases)
        split = {value: self.split(value) for value in vars}
        if by_rows:
            self.store_candidates(vars, split, guard, masks)
            self.cut_body(guard)
            return
        needs = self.needs_of(vars)
        names = {node.attr for node in guard.when.args}
        tested = {var: value for value, var in vars.items() if var.name in names}
        others = tuple([Out(var, value) for value, var in vars.items() if var.name not in names])
        if others:
            self.compute(Compute(others, place))
        lazy = {var.name: Out(var, self.conjunction(*split[value])) for var, value in tested.items()}
        if not needs or not all(split[value][0] for value in tested.values()):
            self.test_masks(lazy, guard)
            return
        # The other parts, and the values that they need, are computed only if the cheap parts hold somewhere.
        first = {var.name: combined("and", split[value][0], graph) for var, value in tested.items()}
        with self.inner() as inner:
            self.test_masks(lazy, guard)
        question = self.answer([first.get(node.attr, node) for node in guard.when.args])
        self.emit(Compute((question,), place, over="words"))
        nothing = graph.flag(False)
        olds = dict.fromkeys(tested, nothing)
        for out in guard.outs:  # the old value may be a mask, which is empty if masks are skipped
            skipped = self.aliases.get(out.value.attr, out.value).attr in lazy
            olds[out.var] = nothing if skipped else out.value
        self.guard(load(graph, question.var), inner, olds, guard.place)

    def test_masks(self, masks: dict[str, Out], guard: Guard) -> None:
        """Store masks, test whether they hold anywhere, and emit the guard."""
        values = {name: out.value for name, out in masks.items()}
        flags = [values.get(node.attr, node) for node in guard.when.args]
        self.ensure(self.needs_of(flags), guard.place)
        words, question = self.computed(masks.values()), self.answer(flags)
        self.emit(Compute((*words, question), guard.place, over="words"))
        olds = {out.var: out.value for out in guard.outs}
        self.guard(load(self.graph, question.var), self.block(guard.body), olds, guard.place)

    def answer(self, flags: Iterable[Node]) -> Out:
        """A new variable: true if any of some flags holds in any cell."""
        some = combined("or", [self.value(flag) for flag in flags], self.graph)
        return Out(self.namer.var(ANSWER), self.graph.node("any", ANSWER, (some,)))

    def split(self, mask: Node) -> tuple[list[Node], list[Node]]:
        """The conjuncts that one loop can compute from stored values, and the others."""
        cheap: list[Node] = []
        rest: list[Node] = []
        for part in conjuncts(mask):
            # Coins are tossed once a step for all masks where planes are processed by rows.
            draws = (node for node in walk(part) if node.op in DRAWS)
            costly = any(not (self.costs.by_rows and is_coin(node)) for node in draws)
            more = not self.is_stored(part) and (costly or of_floats(part) or self.needs(part))
            (rest if more else cheap).append(part)
        return cheap, rest

    def conjunction(self, cheap: list[Node], rest: list[Node]) -> Node:
        """The conjunction; the rest is computed only in words where the cheap parts hold somewhere."""
        if not rest or not cheap:
            return combined("and", [*cheap, *rest], self.graph)
        return self.lazy_conjunction(combined("and", cheap, self.graph), rest)

    def lazy_conjunction(self, first: Node, rest: list[Node]) -> Node:
        """A conjunction under a condition: draws come last, each conditional on everything before it."""
        value = first
        for part in sorted(rest, key=lambda part: part.op in DRAWS):
            if part.op in DRAWS and not self.is_stored(part):
                part = draw_under(part, value, self.graph)
            value = combined("and", [value, part], self.graph)
        return self.graph.node("when", FLAG, (first, value))

    # Masks and movements by rows

    def store_candidates(
        self,
        vars: dict[Node, Var],
        split: dict[Node, tuple[list[Node], list[Node]]],
        guard: Guard,
        masks: Compute,
    ) -> None:
        """Store masks. Costly parts, and the values that they need, come in a second step, if the others hold anywhere."""
        graph, place = self.graph, masks.place
        costly = {value: var for value, var in vars.items() if split[value][1]}
        if not costly or not all(cheap for cheap, _ in split.values()):
            self.ensure(vars, place, vars, masks.when)
            return
        outs = [Out(var, self.conjunction(*split[value])) for value, var in vars.items()]
        second = self.needs_of(out.value for out in outs)
        if second:
            names = [self.namer.var(FLAG) if value in costly else var for value, var in vars.items()]
            firsts = (combined("and", split[value][0], graph) for value in vars)
            outs = list(map(Out, names, firsts))
        self.emit(Compute(self.computed(outs), place, when=masks.when, over="words"))
        if second:
            flags = [load(graph, out.var) for out in outs]
            flags += [node for node in guard.when.args if node.attr not in masks.vars]
            with self.inner() as inner:
                needs = {frozenset(conjuncts(need)): need for need in self.needs_of(vars)}
                for value, candidate in zip(vars, outs, strict=True):
                    cheap, rest = split[value]
                    if need := needs.get(frozenset(cheap)):  # the same parts, read at a neighbor
                        self.stored[need] = candidate.var
                    if rest:
                        self.split_masks[value] = self.lazy_conjunction(load(graph, candidate.var), rest)
                # A mask that the next ones need is stored before them, under its own name.
                self.ensure(costly, place, costly)
            when = graph.node("some", ANSWER, tuple(dict.fromkeys(flags)))
            self.guard(when, inner, dict.fromkeys(costly.values(), graph.flag(False)), guard.place)
        self.stored |= vars

    def computed(self, outs: Iterable[Out]) -> tuple[Out, ...]:
        return tuple([Out(out.var, self.value(self.split_masks.get(out.value, out.value))) for out in outs])

    def shared_parts(self, mask: Node) -> list[Node]:
        """The largest parts that a mask shares with other masks, if one loop can compute them."""
        if self.is_stored(mask) or mask.op == "not":
            return []
        if self.shared[mask] > 1 and mask.op not in UNIFORM and not self.needs(mask):
            parts = [*walk(mask)]
            if not any(part.op in DRAWS or is_movement(part) or is_comparison(part) for part in parts):
                return [mask]
        return [part for arg in mask.args for part in self.shared_parts(arg)] if mask.op == "and" else []

    def cut_body(self, guard: Guard) -> None:
        """The body of a guard: planes that only move do so in place; the rest stays in a guard."""
        outs = [out for loop in guard.body for out in loop.outs]
        movements = self.movements(outs, guard.olds)
        others = tuple([out for out in outs if out.value not in movements])
        first = any(node in movements for out in others for node in walk(out.value))
        if first:
            self.move(movements, guard.place)
        inner: list[Statement] = [part for part in guard.body if isinstance(part, Forget)]
        inner += [Compute(others, guard.place)] if others else []
        if inner:
            body = self.block(tuple(inner))
            olds = {out.var: guard.olds[out.var.name] for out in others}
            self.guard(guard.when, body, olds, guard.place)
        if not first:
            self.move(movements, guard.place)

    def movements(self, outs: Iterable[Out], olds: dict[str, Node]) -> dict[Node, Var]:
        """The writes that move their slot's old value, all with the same movers and offset."""
        movements: dict[Node, Var] = {}
        for out in outs:
            node = out.value
            if is_movement(node) and node.args[0] is olds[out.var.name] and self.is_stored(node.args[1]):
                old, movers, rest = node.args
                left = leftover(old, rest, movers)
                simple = left == "same" if node.op == "swap" else left and abs(node.attr[0]) <= 1
                first = next(iter(movements), node)
                if simple and (node.op, node.attr, movers) == (first.op, first.attr, first.args[1]):
                    movements[node] = out.var
        return movements

    def move(self, movements: dict[Node, Var], place: str) -> None:
        if movements:
            first, outs = next(iter(movements)), []
            for node, var in movements.items():
                old, _, leaves = map(self.value, node.args)
                outs.append(Out(var, leaves, old))
            movers = self.value(first.args[1])
            self.emit(Move(tuple(outs), place, region=movers, op=first.op, offset=first.attr))
            self.stored |= movements

    # What must be stored

    def chain(self, node: Node) -> list[Node]:
        """At least FEWEST choices, outermost first, whose values read stored variables only; else nothing."""
        chain: list[Node] = []
        while node.op == "select" and node.type == REAL and not self.is_stored(node) and self.costs.by_rows:
            if node.args[0].op == "param":
                return []
            chain.append(node)
            node = node.args[2]
        if len(chain) < FEWEST or node.op in UNIFORM:  # a value that is the same in all cells has no field
            return []
        # A choice may build on the one below it, which the row still holds, not on those before.
        for choice in chain:
            _, value, base = choice.args
            stack = [value]
            for part in taken(stack):
                if part is base or self.is_stored(part):
                    continue
                around = part.op == "shift" and not self.is_stored(base) and base in walk(part)
                if around or part.op in ("select", "draw"):
                    return []
                stack.extend(part.args)
        return chain

    def needs_of(self, nodes: Iterable[Node]) -> list[Node]:
        return [need for node in nodes for need in self.needs(node)]

    def needs(self, node: Node) -> list[Node]:
        """The nodes that must be stored before a node can be computed."""
        if self.is_stored(node):
            return []
        if self.costs.by_rows and is_movement(node):
            return [arg for arg in node.args if not self.is_stored(arg)]
        if chain := self.chain(node):
            needs = [choice.args[0] for choice in chain]
            for choice in chain:
                needs += self.cell_needs(choice.args[1])
            needs.append(chain[-1].args[2])
            return [need for need in needs if not self.is_stored(need) and need not in chain]
        return self.cell_needs(node) if of_floats(node) else self.word_needs(node)

    def is_recomputed(self, source: Node, reader: Node) -> bool:
        """True if a flag that a node reads at a neighbor is recomputed there, or stored already."""
        if self.is_stored(source):
            return True
        readers, gates = self.readers.get(source, 1), self.costs.gates
        if not self.costs.by_rows:
            return is_recomputable(source, self.is_stored, max(1, gates // readers))
        _, dx, wraps = reader.attr
        # A value that is read at one neighbor would fill a plane for that reader alone.
        alone = readers == 1
        limit = gates + ONLY_READER * alone + 1
        cheap = abs(dx) <= alone and gate_cost(source, self.is_stored, limit) < limit
        return wraps and (is_constant(source) or cheap)

    def word_needs(self, node: Node) -> list[Node]:
        """The flags at neighbors, the floats and the movements that a loop over words reads."""
        needs: dict[Node, None] = {}
        stack = [node]
        for top in taken(stack):
            if self.is_stored(top) or top.op in UNIFORM:
                continue
            if of_floats(top) or (self.costs.by_rows and is_movement(top)):
                needs[top] = None
                continue
            sources = dict(sources_of(top))
            for source in sources:
                if self.is_recomputed(source, top):
                    stack.append(source)
                else:
                    needs[source] = None
            stack += [arg for arg in top.args if arg not in sources]
        return [*needs]

    def cell_needs(self, node: Node) -> list[Node]:
        """The flags, then the floats, that a loop over cells reads."""
        in_place = node.op == "clamp" and match_slot_choices(node, self.input_slots)
        needs: dict[Node, None] = {}
        stack = [node]
        for top in taken(stack):
            if top is not node and self.is_stored(top):
                continue
            if top is not node and not in_place and self.chain(top):
                needs[top] = None  # long chains are applied before the loop that reads them
            elif top.op == "select" and of_floats(top.args[0]) and not self.is_stored(top.args[0]):
                needs[top.args[0]] = None  # choices read stored flags
                stack.extend(top.args[1:])
            elif top is not node and not of_floats(top):
                needs |= {} if top.op == "param" else {top: None}
            elif top.op == "shift":
                source = top.args[0]
                if not self.is_stored(source):
                    wraps, most = top.attr[2], self.costs.floats
                    parts = stored_parts(source, self.is_stored, most) if wraps else (source,)
                    needs |= dict.fromkeys(parts)
                    stack.extend([] if parts else [source])
            else:
                stack.extend(top.args)
        return sorted(needs, key=lambda need: need.type == REAL)

    def ensure(
        self,
        nodes: Iterable[Node],
        place: str,
        named: dict[Node, Var] | None = None,
        when: Node | None = None,
    ) -> None:
        """Store nodes, after the nodes that they need. `when`: see `Compute`."""
        named = named or {}
        wanted = [node for node in dict.fromkeys(nodes) if node.op not in UNIFORM or node.type != REAL]
        while before := self.needs_of(wanted):
            self.ensure(before, place, named)
        wanted = [node for node in wanted if not self.is_stored(node)]
        cells = dict.fromkeys(filter(of_floats, wanted))
        # Floats that are read at neighbors later are stored where they are computed anyway.
        for node in [*cells]:
            for part in walk(node):
                if part in self.read_at_neighbors and not self.is_stored(part):
                    cells[part] = None

        def outs(nodes: Iterable[Node]) -> list[Out]:
            return [Out(named.get(node) or self.namer.var(node.type), node) for node in nodes]

        chains: dict[tuple[Node, ...], list[Out]] = {}
        for out in outs(filter(self.chain, cells)):
            masks = tuple(choice.args[0] for choice in self.chain(out.value))
            chains.setdefault(masks, []).append(out)
        for group in chains.values():  # chains with the same masks share a loop
            self.loop(group, place, "choices")
        floats = [node for node in cells if not self.is_stored(node)]
        for nodes in connected(floats, _operations) if self.costs.by_rows else [floats]:
            self.loop(outs(nodes), place, "cells")
        moves = [node for node in wanted if self.costs.by_rows and is_movement(node)]
        flags = [node for node in wanted if node not in cells and node not in moves]
        self.loop(outs(flags), place, "words", when)
        together: dict[tuple[str, Offset, Node], dict[Node, Var]] = {}
        for out in outs(moves):
            key = (out.value.op, out.value.attr, self.variable(out.value.args[1]))
            together.setdefault(key, {})[out.value] = out.var
        for planes in together.values():
            self.move(planes, place)

    def loop(
        self,
        outs: list[Out],
        place: str,
        over: Literal["words", "cells", "choices"],
        when: Node | None = None,
    ) -> None:
        """A loop: floats first, then comparisons, each after the one under which it is computed."""
        if outs:
            outs = sorted(outs, key=lambda out: (out.var.type != REAL, out.value.op == "led"))
            self.emit(Compute(self.computed(outs), place, when=when, over=over))
            for out in outs:
                self.stored.setdefault(out.value, out.var)

    def value(self, root: Node) -> Node:
        """A value in a loop: only variables are read at neighbors, the rest is recomputed."""
        graph = self.graph
        done: dict[tuple[Node, int, int], Node] = {}
        for place, below in needed([(root, 0, 0)], self.below).items():
            node, dy, dx = place
            args = tuple([done[part] for part in below])
            if self.is_stored(node):
                new = self.variable(node)
                new = graph.node("shift", node.type, (new,), (dy, dx, True)) if dy or dx else new
            elif node.op == "shift" and not below:
                new = graph.node("shift", node.type, (self.variable(node.args[0]),), node.attr)
            elif node.op == "shift":
                inside = () if node.attr[2] else (graph.node("inside", FLAG, (), node.attr[:2]),)
                new = combined("and", (*args, *inside), graph)
            elif is_movement(node):
                new = graph.node("select", FLAG, args if node.op == "arrive" else (*args[1:], args[0]))
            else:
                new = graph.node(node.op, node.type, args, node.attr)
            done[place] = new
        return done[root, 0, 0]

    def below(self, place: tuple[Node, int, int]) -> list[tuple[Node, int, int]]:
        """The nodes from which a node at a neighbor is computed, with the neighbors at which they are read."""
        node, dy, dx = place
        if self.is_stored(node) or not node.args:
            return []
        if node.op == "shift":
            sy, sx, wraps = node.attr
            stored = not wraps and self.is_stored(node.args[0])
            return [] if stored else [(node.args[0], dy + sy, dx + sx)]
        if is_movement(node):
            (sy, sx), (content, movers, rest) = node.attr, node.args
            if node.op == "arrive":
                return [(movers, -sy, -sx), (content, -sy, -sx), (rest, 0, 0)]
            arrived = self.graph.node("arrive", FLAG, node.args, node.attr)
            return [(arrived, 0, 0), (movers, 0, 0), (content, sy, sx)]
        return [(arg, dy, dx) for arg in node.args]


def _operations(node: Node) -> set[object]:
    """The keys of a float, for `connected`: floats that share an operation, or the masks of all choices, share a loop."""
    parts = [part for part in walk(node) if part.args]
    masks = frozenset(part.args[0] for part in parts if part.op == "select")
    return {*filter(of_floats, parts), ("masks", masks)}
