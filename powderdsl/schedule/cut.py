"""Cuts statements into loops: which values are stored for later loops, and which are recomputed.

A loop over words reads flags of its own word; at neighbors it reads stored flags, or recomputes cheap ones.
A loop over cells reads floats and stored flags.

Some targets process whole planes `by_rows` and know which planes are empty. Testing a mask is free there. Movements are
operations on whole planes, in place where a substep only moves them. Long chains of choices are applied to a field one
after another.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Literal

from powderdsl.ir.ops import FLAG, REAL, Node, Offset, ordered, walk
from powderdsl.schedule.costs import (
    DRAWS,
    UNIFORM,
    Costs,
    asked_for,
    gate_cost,
    is_coin,
    is_constant,
    movable,
    sources_of,
    stored_parts,
)
from powderdsl.schedule.floats import is_comparison, of_floats, unchanged
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
    asked_masks,
    combined,
    conjunctions,
    conjuncts,
    connected,
    constant,
    is_movement,
    leftover,
    load,
    loaded,
    needed,
    taken,
)

ONLY_READER = 4
"""How many gates more are recomputed for a single reader: about what a loop that stores a plane costs."""

FEWEST = 3
"""The shortest chain of choices that is worth a field of its own."""


def cut(costs: Costs) -> Callable[[Schedule], Schedule]:
    """The stage for a target: every `Compute` becomes loops over words and loops over cells.

    `p = f(a)[0,1] & b`, where f is costly → `loop words: t = f(a)`, `loop words: p = t[0,1] & b`.
    """

    def stage(schedule: Schedule) -> Schedule:
        cutter = _Cutter(schedule, costs)
        body = cutter.block(schedule.body, top=True)
        leaves = tuple((slot, cutter.renamed(node)) for slot, node in schedule.leaves)
        return replace(schedule, body=body, leaves=leaves)

    return stage


class _Cutter:
    def __init__(self, schedule: Schedule, costs: Costs):
        self.namer, self.graph, self.costs = Namer(schedule), schedule.graph, costs
        self.statements: list[Statement] = []
        self.known: dict[Node, Var] = {}
        """The variables of the values stored so far."""
        self.found = {var.name for _, var in schedule.finds}
        self.there = set(self.found)
        """The variables defined so far."""
        self.same: dict[str, Node] = {}
        """For each variable that is only another name: the load of the variable that it names."""
        nodes = ordered(schedule.values)
        led = {node.args[1]: node for node in nodes if node.op == "led"}
        self.comparisons = {node: led.get(node, node) for node in nodes if is_comparison(node)}
        """What is computed for each comparison: itself, or only where another one holds."""
        offsets: dict[Node, set[Offset]] = {}
        for node in nodes:
            for source, offset in sources_of(node):
                offsets.setdefault(source, set()).add(offset)
        self.askers = {source: len(where) for source, where in offsets.items()}
        """At how many neighbors each node is read."""
        shifted = [node.args[0] for node in nodes if node.op == "shift" and node.type == REAL]
        self.wanted = {part for node in shifted for part in stored_parts(node, self.have, costs.floats)}
        """Floats that are read at neighbors later."""
        counts: Counter[Node] = Counter()
        for _, masks in asked_masks(schedule.body):
            counts.update({part for out in masks for part in conjunctions(out.value)})
        self.shared = {part for part, count in counts.items() if count > 1}
        """Conjuncts that several masks have in common: if such a plane is empty, so are all these masks."""
        self.split_masks: dict[Node, Node] = {}
        """Masks whose first parts are stored: the stored parts and the rest."""

    def emit(self, statement: Statement) -> None:
        self.statements.append(statement)
        self.there.update(statement.vars)

    @contextmanager
    def inner(self) -> Iterator[list[Statement]]:
        """Collects the statements of a nested block; what they store is not known after it."""
        outer = self.statements, self.known, self.there
        self.statements, self.known, self.there = [], dict(self.known), set(self.there)
        yield self.statements
        self.statements, self.known, self.there = outer

    def alias(self, names: dict[str, Node]) -> None:
        """Note variables that are only other names of values."""
        self.same |= names
        self.there |= names.keys()

    def have(self, node: Node) -> bool:
        return node.op == "load" or node in self.known

    def variable(self, node: Node) -> Node:
        """The load of a stored node."""
        stored = node if node.op == "load" else load(self.graph, self.known[node])
        return self.same.get(stored.attr, stored)

    def renamed(self, node: Node) -> Node:
        return self.variable(node) if node.op == "load" else node

    def kept(self, guard: Guard) -> dict[str, Node]:
        """The values that variables have if a guard's body is skipped."""
        return {name: self.renamed(old) for name, old in guard.olds.items()}

    def guard(self, when: Node, body: Block, outs: Iterable[tuple[Var, Node]], place: str) -> None:
        """Emit statements that run only if an answer is true, and the values of variables if it is not."""
        self.emit(Guard(tuple(Out(var, old, old) for var, old in outs), place, when=when, body=body))

    # Statements

    def block(self, body: Block, kept: Collection[str] = (), *, top: bool = False) -> Block:
        """A block as loops. `kept`: names that the guard around the block keeps."""
        with self.inner() as statements:
            for before, statement, after in zip((None, *body), body, (*body[1:], None), strict=False):
                if isinstance(statement, Guard):
                    masks = before if isinstance(before, Compute) else Compute((), statement.place)
                    self.guarded(masks, statement)
                elif isinstance(statement, Compute):
                    is_mask = isinstance(after, Guard)
                    if top and (is_mask or all(out.var.type == FLAG for out in statement.outs)):
                        self.hoist_comparisons(statement)
                    if not is_mask:
                        self.compute(statement, kept)
                else:
                    self.emit(statement)
        return tuple(statements)

    def compute(self, loop: Compute, kept: Collection[str] = ()) -> None:
        """Store values under the names of their variables."""
        named = {out.value: out.var for out in reversed(loop.outs) if not self.have(out.value)}
        self.ensure(loop.results, loop.place, named, loop.when)
        for out in loop.outs:
            if named.get(out.value) is not out.var:
                value = self.variable(out.value)
                if out.var.name in kept:
                    self.emit(Compute((Out(out.var, value),), loop.place, over="words"))
                else:
                    self.alias({out.var.name: value})

    def hoist_comparisons(self, masks: Compute) -> None:
        """Compute the comparisons of masks before the guard, with all others that the same loop can compute."""
        nodes = [node for value in masks.results for node in walk(value) if is_comparison(node)]
        computed = dict.fromkeys(self.comparisons[node] for node in nodes if not self.have(node))
        if asked := [node for node in computed if not self.have(node)]:
            self.ensure(self.needs_of(asked), masks.place)
            ready = [
                node
                for node in self.comparisons.values()
                if not self.have(node) and not self.needs(node) and self.there.issuperset(loaded([node]))
            ]
            self.ensure([*asked, *ready], masks.place)

    # Masks and guards

    def guarded(self, masks: Compute, guard: Guard) -> None:
        """Masks and the guard that tests them: the cheap parts first, the rest only if those hold somewhere."""
        if self.costs.by_rows:
            parts = [part for out in masks.outs for part in self.shared_parts(out.value)]
            self.ensure(parts, masks.place)
        # A mask may be known by another name, or be such a part itself.
        self.alias({out.var.name: self.variable(out.value) for out in masks.outs if self.have(out.value)})
        masks = replace(masks, outs=tuple(out for out in masks.outs if out.var.name not in self.same))
        if self.costs.by_rows:
            self.candidates(masks, guard)
            self.then(guard)
            return
        graph, place = self.graph, masks.place
        split = {out.var.name: self.split(out.value) for out in masks.outs}
        needs = self.needs_of(masks.results)
        asked = {node.attr for node in guard.when.args if node.op == "load"}
        mine = [out for out in masks.outs if out.var.name in asked]
        if len(mine) < len(masks.outs):
            others = tuple(out for out in masks.outs if out.var.name not in asked)
            self.compute(replace(masks, outs=others))
        lazy = [Out(out.var, self.lazily(*split[out.var.name])) for out in mine]
        if not needs or not all(split[out.var.name][0] for out in mine):
            self.ask(lazy, guard)
            return
        # The other parts, and what they need, are computed only if the cheap parts hold somewhere.
        first = [
            combined("and", split[node.attr][0], graph) if node.attr in split else node
            for node in guard.when.args
        ]
        with self.inner() as inner:
            self.ask(lazy, guard)
        nothing = constant(graph, FLAG)
        names = {out.var.name for out in mine}
        # A mask may be what a slot held before: nothing, where masks are skipped.
        olds = {name: nothing if old.attr in names else old for name, old in self.kept(guard).items()}
        question = self.answer(first)
        self.emit(Compute((question,), place, over="words"))
        outs = [(out.var, nothing) for out in mine] + [(guard.vars[name], old) for name, old in olds.items()]
        self.guard(load(graph, question.var), tuple(inner), outs, guard.place)

    def ask(self, masks: list[Out], guard: Guard) -> None:
        """Store masks, test whether they hold anywhere, and emit the guard."""
        values = {out.var.name: out.value for out in masks}
        asked = [values.get(node.attr, node) if node.op == "load" else node for node in guard.when.args]
        self.ensure(self.needs_of(asked), guard.place)
        words, question = self.computed(masks), self.answer(asked)
        self.emit(Compute((*words, question), guard.place, over="words"))
        body, olds = self.block(guard.body, guard.vars), self.kept(guard)
        outs = [(var, olds[name]) for name, var in guard.vars.items()]
        self.guard(load(self.graph, question.var), body, outs, guard.place)

    def answer(self, flags: Iterable[Node]) -> Out:
        """A new variable: whether one of some flags holds in any cell."""
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
            more = not self.have(part) and (costly or of_floats(part) or self.needs(part))
            (rest if more else cheap).append(part)
        return cheap, rest

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

    # Masks and movements by rows

    def candidates(self, masks: Compute, guard: Guard) -> None:
        """Masks, in two steps where they have costly parts: these, and what they need, only if the others hold anywhere."""
        graph, place = self.graph, masks.place
        vars: dict[Node, Var] = {}
        for out in masks.outs:
            if (first := vars.setdefault(out.value, out.var)) is not out.var:
                self.alias({out.var.name: load(graph, first)})
        split = {value: self.split(value) for value in vars}
        costly = {value: var for value, var in vars.items() if split[value][1]}
        if not costly or not all(cheap for cheap, _ in split.values()):
            self.ensure(vars, place, vars, masks.when)
            return
        whole = [Out(var, self.lazily(*split[value])) for value, var in vars.items()]
        if not self.needs_of(out.value for out in whole):
            self.emit(Compute(self.computed(whole), place, when=masks.when, over="words"))
            self.known |= vars
            return
        candidates = [
            Out(self.namer.var(FLAG) if value in costly else var, combined("and", split[value][0], graph))
            for value, var in vars.items()
        ]
        self.emit(Compute(self.computed(candidates), place, when=masks.when, over="words"))
        asked = [load(graph, out.var) for out in candidates]
        asked += [self.renamed(node) for node in guard.when.args if node.attr not in masks.vars]
        with self.inner() as inner:
            needs = {frozenset(conjuncts(need)): need for need in self.needs_of(vars)}
            for value, candidate in zip(vars, candidates, strict=True):
                cheap, rest = split[value]
                if need := needs.get(frozenset(cheap)):  # the same parts, read at a neighbor
                    self.known[need] = candidate.var
                if rest:
                    self.split_masks[value] = self.under(load(graph, candidate.var), rest)
            # A mask that the next ones need is stored before them, under its own name.
            self.ensure(costly, place, costly)
        when = graph.node("some", ANSWER, tuple(dict.fromkeys(asked)))
        outs = [(var, constant(graph, FLAG)) for var in costly.values()]
        self.guard(when, tuple(inner), outs, guard.place)
        self.known |= vars

    def computed(self, outs: Iterable[Out]) -> tuple[Out, ...]:
        """Variables with the values that a loop computes."""
        return tuple(Out(out.var, self.value(self.split_masks.get(out.value, out.value))) for out in outs)

    def shared_parts(self, mask: Node) -> list[Node]:
        """The largest parts that a mask shares with other masks, if one loop can compute them."""
        if self.have(mask) or mask.op == "not":
            return []
        simple = mask in self.shared and mask.op not in UNIFORM and not self.needs(mask)
        if simple and not any(
            node.op in DRAWS or is_movement(node) or is_comparison(node) for node in walk(mask)
        ):
            return [mask]
        return [part for arg in mask.args for part in self.shared_parts(arg)] if mask.op == "and" else []

    def then(self, guard: Guard) -> None:
        """The body of a guard: planes that only move do so in place; the rest stays in a guard."""
        when = self.graph.node("some", ANSWER, tuple(self.renamed(node) for node in guard.when.args))
        outs = [out for one in guard.body if isinstance(one, Compute) for out in one.outs]
        olds = self.kept(guard)
        carried = self.carried(outs, olds)
        others = tuple(out for out in outs if out.value not in carried)
        first = any(node in carried for out in others for node in walk(out.value))
        if first:
            self.move(carried, guard.place)
        inner: list[Statement] = [one for one in guard.body if isinstance(one, Forget)]
        inner += [Compute(others, guard.place)] if others else []
        if inner:
            body = self.block(tuple(inner), {out.var.name for out in others})
            self.guard(when, body, [(out.var, olds[out.var.name]) for out in others], guard.place)
        if not first:
            self.move(carried, guard.place)

    def carried(self, outs: Iterable[Out], olds: dict[str, Node]) -> dict[Node, Var]:
        """Writes that move their slot's old value, all with the same movers and offset."""
        carried: dict[Node, Var] = {}
        for out in outs:
            node = out.value
            if is_movement(node) and node.args[0] is olds[out.var.name] and self.have(node.args[1]):
                old, movers, rest = node.args
                left = leftover(old, rest, movers)
                simple = left == "same" if node.op == "swap" else left and abs(node.attr[0]) <= 1
                first = next(iter(carried), node)
                if simple and (node.op, node.attr, movers) == (first.op, first.attr, first.args[1]):
                    carried[node] = out.var
        return carried

    def move(self, carried: dict[Node, Var], place: str) -> None:
        """Planes that move in place."""
        if not carried:
            return
        mask, planes = self.variable(next(iter(carried)).args[1]), []
        for node, var in carried.items():
            old, _, rest = node.args
            leaves = old
            if rest is not old:
                gone = self.graph.node("not", FLAG, (mask,)) if rest.op == "and" else mask
                leaves = self.graph.node(rest.op, FLAG, (old, gone))
            planes.append(Out(var, leaves, old))
        self.emit(Move(tuple(planes), place, region=mask, op=node.op, offset=node.attr))
        self.known |= carried

    # What must be stored

    def chain(self, node: Node) -> list[Node]:
        """At least FEWEST choices, outermost first, whose values read stored variables only; else nothing."""
        chain: list[Node] = []
        while node.op == "select" and node.type == REAL and not self.have(node) and self.costs.by_rows:
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
                if part is base or self.have(part):
                    continue
                around = part.op == "shift" and not self.have(base) and base in walk(part)
                if around or part.op in ("select", "draw"):
                    return []
                stack.extend(part.args)
        return chain

    def needs_of(self, nodes: Iterable[Node]) -> list[Node]:
        return [need for node in nodes for need in self.needs(node)]

    def needs(self, node: Node) -> list[Node]:
        """What must be stored before a node can be computed."""
        if self.have(node):
            return []
        if self.costs.by_rows and is_movement(node):
            return [arg for arg in node.args if not self.have(arg)]
        if chain := self.chain(node):
            parts = [part for choice in chain for part in self.cell_needs(choice.args[1])]
            needs = [*(choice.args[0] for choice in chain), *parts, chain[-1].args[2]]
            return [need for need in needs if not self.have(need) and need not in chain]
        return self.cell_needs(node) if of_floats(node) else self.word_needs(node)

    def is_again(self, source: Node, reader: Node) -> bool:
        """Whether a flag that a node reads at a neighbor is recomputed there, or stored already."""
        if self.have(source):
            return True
        askers, gates = self.askers.get(source, 1), self.costs.gates
        if not self.costs.by_rows:
            return movable(source, self.have, max(1, gates // askers))
        _, dx, wraps = reader.attr
        # What is read at one neighbor only would fill a plane for it alone.
        alone = askers == 1
        cheap = gate_cost(source, self.have) <= gates + (ONLY_READER if alone else 0)
        return wraps and (is_constant(source) or (cheap and abs(dx) <= (1 if alone else 0)))

    def word_needs(self, node: Node) -> list[Node]:
        """The flags at neighbors, the floats and the movements that a loop over words reads."""
        needs: dict[Node, None] = {}
        stack = [node]
        for top in taken(stack):
            if self.have(top) or top.op in UNIFORM:
                continue
            if of_floats(top) or (self.costs.by_rows and is_movement(top)):
                needs[top] = None
                continue
            sources = dict.fromkeys(source for source, _ in sources_of(top))
            for source in sources:
                if self.is_again(source, top):
                    stack.append(source)
                else:
                    needs[source] = None
            stack.extend(arg for arg in top.args if arg not in sources)
        return [*needs]

    def cell_needs(self, node: Node) -> list[Node]:
        """The flags, then the floats, that a loop over cells reads."""
        kept = node.op == "settle" and unchanged(node, self.found)
        needs: dict[Node, None] = {}
        stack = [node]
        for top in taken(stack):
            if top is not node and self.have(top):
                continue
            if top is not node and not kept and self.chain(top):
                needs[top] = None  # long chains are applied before the loop that reads them
            elif top.op == "led":
                stack.extend(top.args)
            elif top.op == "select" and of_floats(top.args[0]) and not self.have(top.args[0]):
                needs[top.args[0]] = None  # choices read stored flags
                stack.extend(top.args[1:])
            elif top.type != REAL and top is not node and not is_comparison(top):
                needs |= {} if top.op == "param" else {top: None}
            elif top.op == "shift":
                source = top.args[0]
                if not self.have(source):
                    parts = stored_parts(source, self.have, self.costs.floats) if top.attr[2] else [source]
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
        """Store nodes, after everything that they need. `when`: see `Compute`."""
        named = named or {}
        wanted = [node for node in dict.fromkeys(nodes) if node.op not in UNIFORM or node.type != REAL]
        while wanted := [node for node in wanted if not self.have(node)]:
            before = [need for need in self.needs_of(wanted) if not self.have(need)]
            if not before:
                break
            self.ensure(before, place, named)
        floats = [node for node in wanted if of_floats(node)]
        # Floats that are read at neighbors later are stored here, where they are computed anyway.
        floats += [
            part for node in floats for part in walk(node) if part in self.wanted and not self.have(part)
        ]
        floats = [*dict.fromkeys(floats)]
        flags = [node for node in wanted if node not in floats]

        def outs(nodes: Iterable[Node]) -> list[Out]:
            return [Out(named.get(node) or self.namer.var(node.type), node) for node in nodes]

        chains: dict[tuple[Node, ...], list[Out]] = {}
        for out in outs(filter(self.chain, floats)):
            masks = tuple(choice.args[0] for choice in self.chain(out.value))
            chains.setdefault(masks, []).append(out)
        for group in chains.values():  # chains with the same masks share a loop
            self.loop(group, place, "choices")
        floats = [node for node in floats if not self.have(node)]
        for nodes in connected(floats, _operations) if self.costs.by_rows else [floats]:
            self.loop(outs(nodes), place, "cells")
        moves = [node for node in flags if self.costs.by_rows and is_movement(node)]
        self.loop(outs(node for node in flags if node not in moves), place, "words", when)
        together: dict[tuple[str, Offset, Node], list[Out]] = {}
        for out in outs(moves):
            content, movers, rest = map(self.variable, out.value.args)
            key = (out.value.op, out.value.attr, movers)
            together.setdefault(key, []).append(Out(out.var, rest, content))
            self.known[out.value] = out.var
        for (op, offset, movers), planes in together.items():
            self.emit(Move(tuple(planes), place, region=movers, op=op, offset=offset))

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
                self.known.setdefault(out.value, out.var)

    def value(self, root: Node) -> Node:
        """A value in a loop: only variables are read at neighbors, the rest is recomputed."""
        graph = self.graph
        done: dict[tuple[Node, int, int], Node] = {}
        for place in needed((root, 0, 0), self.below):
            node, dy, dx = place
            below = self.below(place)
            args = tuple([done[part] for part in below])
            if self.have(node):
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
        if self.have(node):
            return []
        if node.op == "shift":
            sy, sx, wraps = node.attr
            stored = not wraps and self.have(node.args[0])
            return [] if stored else [(node.args[0], dy + sy, dx + sx)]
        if is_movement(node):
            (sy, sx), (content, movers, rest) = node.attr, node.args
            if node.op == "arrive":
                return [(movers, -sy, -sx), (content, -sy, -sx), (rest, 0, 0)]
            arrived = self.graph.node("arrive", FLAG, node.args, node.attr)
            return [(arrived, 0, 0), (movers, 0, 0), (content, sy, sx)]
        return [(arg, dy, dx) for arg in node.args]


def _operations(node: Node) -> set[object]:
    """What floats have in common that are computed in the same loop: an operation, or the masks of all choices."""
    parts = [part for part in walk(node) if part.args]
    masks = frozenset(part.args[0] for part in parts if part.op == "select")
    return {*filter(of_floats, parts), ("masks", masks)}
