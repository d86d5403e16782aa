"""Cuts statements into loops for targets that process whole planes row by row and know which planes are empty.

Testing a mask is free there. Movements are operations on whole planes, in place where a substep only moves them. Long
chains of choices are applied to a field one after another.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

from powderdsl.ir.ops import FLAG, REAL, Node, Offset, walk
from powderdsl.schedule.costs import DRAWS, UNIFORM, Costs, Have, is_coin, is_constant
from powderdsl.schedule.cut import Cutter, Pairs
from powderdsl.schedule.floats import is_comparison, of_floats
from powderdsl.schedule.types import (
    Carried,
    Compute,
    Forget,
    Guard,
    Move,
    Out,
    Schedule,
    Statement,
    Var,
    combined,
    conjuncts,
    is_movement,
    load,
)

ONLY_READER = 4
"""How many gates more are recomputed for a single reader: about what a loop that stores a plane costs."""

FEWEST = 3
"""The shortest chain of choices that is worth a field of its own."""


def cut_rows(costs: Costs) -> Callable[[Schedule], Schedule]:
    """The stage for a target, see `cut`."""

    def stage(schedule: Schedule) -> Schedule:
        cutter = _RowCutter(schedule, costs)
        body = cutter.block(schedule.body, top=True)
        leaves = tuple((slot, cutter.renamed(node)) for slot, node in schedule.leaves)
        return replace(schedule, body=tuple(body), leaves=leaves)

    return stage


def gate_cost(node: Node, have: Have, limit: int = 1000) -> int:
    """The number of gates that recompute a flag in another row; `limit` if that is impossible."""
    if have(node) or is_constant(node):
        return 0
    if node.op in UNIFORM:
        return limit
    if is_movement(node) or of_floats(node) or node.op in DRAWS:
        return limit
    if node.op == "shift":
        _, dx, wraps = node.attr
        return gate_cost(node.args[0], have, limit) if wraps and not dx else limit
    total = 2 if node.op == "select" else 1
    for arg in node.args:
        total += gate_cost(arg, have, limit)
        if total >= limit:
            return limit
    return total


def chain_of(node: Node, have: Have) -> list[Node]:
    """A chain of at least FEWEST choices, outermost first, whose values read stored variables only; else nothing."""
    chain: list[Node] = []
    while node.op == "select" and node.type == REAL and not have(node):
        if node.args[0].op == "param":
            return []
        chain.append(node)
        node = node.args[2]
    if len(chain) < FEWEST or node.op in UNIFORM:  # a value that is the same in all cells has no field
        return []
    # A choice may build on the one below it, which the row still holds, not on those before.
    for choice in chain:
        seen, others = {id(choice.args[2])}, set[int]()
        stack = [choice.args[1]]
        while stack:
            part = stack.pop()
            if id(part) in seen or have(part):
                continue
            seen.add(id(part))
            if part.op in ("select", "draw"):
                return []
            if part.op == "shift" and not have(choice.args[2]) and _reads(part, choice.args[2], others):
                return []
            stack.extend(part.args)
    return chain


def _reads(node: Node, read: Node, others: set[int]) -> bool:
    """Whether a value reads another one. `others`: the ids of nodes that do not; those found are added."""
    stack = [node]
    while stack:
        top = stack.pop()
        if top is read:
            return True
        if id(top) not in others:
            others.add(id(top))
            stack.extend(top.args)
    return False


def _is_kept(node: Node, found: set[str]) -> bool:
    """Whether a float is a clamped slot with some cells replaced by choices."""
    if node.op != "settle":
        return False
    node = node.args[0]
    while node.op == "select" and node.args[0].op != "param":
        node = node.args[2]
    return node.op == "load" and node.attr in found


class _RowCutter(Cutter):
    def __init__(self, schedule: Schedule, costs: Costs):
        super().__init__(schedule, costs)
        self.found = {var.name for _, var in schedule.finds}
        counts: Counter[int] = Counter()
        for i, statement in enumerate(schedule.body[1:]):
            masks = schedule.body[i]
            if isinstance(statement, Guard) and isinstance(masks, Compute):
                asked = {node.attr for node in statement.when}
                roots = [out.value for out in masks.outs if out.var.name in asked]
                counts.update({id(part) for root in roots for part in _conjunctions(root)})
        self.shared = {key for key, count in counts.items() if count > 1}
        """Conjuncts that several masks have in common: if such a plane is empty, so are all these masks."""
        self.split_masks: dict[int, Node] = {}
        """Masks whose first parts are stored, by the id of the whole mask: the stored parts and the rest."""

    # Masks

    def guarded(self, masks: Compute, guard: Guard) -> None:
        place = masks.place
        self.ensure([part for out in masks.outs for part in self.shared_parts(out.value)], place)
        # A mask may be known by another name, or be such a part itself.
        self.alias({out.var.name: self.variable(out.value) for out in masks.outs if self.have(out.value)})
        firsts: dict[int, Out] = {}
        for out in masks.outs:
            first = firsts.setdefault(id(out.value), out)
            if first is not out and out.var.name not in self.same:
                self.alias({out.var.name: load(self.graph, first.var)})
        outs = [out for out in firsts.values() if out.var.name not in self.same]
        split = {id(out): self.split(out.value) for out in outs}
        if any(rest for _, rest in split.values()) and all(cheap for cheap, _ in split.values()):
            self.in_two(outs, split, masks, guard)
        else:
            named = {id(out.value): out.var for out in reversed(outs)}
            self.ensure([out.value for out in outs], place, named, masks.when)
        self.then(guard)

    def is_costly(self, node: Node) -> bool:
        return node.op in DRAWS and not is_coin(node)  # coins are tossed once a step for all masks

    def in_two(
        self,
        outs: list[Out],
        split: dict[int, tuple[list[Node], list[Node]]],
        masks: Compute,
        guard: Guard,
    ) -> None:
        """Candidates first; the rest, and what it needs, only if there are any."""
        graph, place = self.graph, masks.place
        whole = [replace(out, value=self.lazily(*split[id(out)])) for out in outs]
        if not any(self.needs(out.value) for out in whole):
            words = tuple(replace(out, value=self.word(out.value)) for out in whole)
            self.emit(Compute(words, place, "words", when=masks.when))
            self.known |= {id(out.value): out.var for out in outs}
            return
        candidates = []
        for out in outs:
            cheap, rest = split[id(out)]
            var = self.namer.var(FLAG) if rest else out.var
            candidates.append(Out(var, self.word(combined("and", cheap, graph))))
        self.emit(Compute(tuple(candidates), place, "words", when=masks.when))
        asked = [load(graph, out.var) for out in candidates]
        mine = {out.var.name for out in outs}
        asked += [self.renamed(node) for node in guard.when if node.attr not in mine]
        outer, self.statements = self.statements, []
        scope = dict(self.known), set(self.there)
        needed = {frozenset(map(id, conjuncts(need))): need for out in outs for need in self.needs(out.value)}
        for out, candidate in zip(outs, candidates, strict=True):
            need = needed.get(frozenset(map(id, split[id(out)][0])))
            if need is not None:  # the same parts, read at a neighbor
                self.known[id(need)] = candidate.var
        lazy = [out for out in outs if split[id(out)][1]]
        for out, candidate in zip(outs, candidates, strict=True):
            if rest := split[id(out)][1]:
                self.split_masks[id(out.value)] = self.under(load(graph, candidate.var), rest)
        # A mask that the next ones need is stored before them, under its own name.
        self.ensure([out.value for out in lazy], place, {id(out.value): out.var for out in reversed(lazy)})
        inner, self.statements = self.statements, outer
        self.known, self.there = scope
        nothing = graph.node("const", FLAG, (), False)
        kept = tuple((out.var, nothing) for out in lazy)
        self.emit(Guard(tuple(dict.fromkeys(asked)), tuple(inner), kept, guard.place))
        self.known |= {id(out.value): out.var for out in outs}

    def ask(self, masks: list[Out], guard: Guard) -> None:
        self.then(guard)

    def shared_parts(self, mask: Node) -> list[Node]:
        """The largest parts that a mask shares with other masks, if one loop can compute them."""
        if self.have(mask) or mask.op == "not":
            return []
        simple = id(mask) in self.shared and mask.op not in UNIFORM and not self.needs(mask)
        if simple and not any(
            node.op in DRAWS or is_movement(node) or is_comparison(node) for node in walk(mask)
        ):
            return [mask]
        return [part for arg in mask.args for part in self.shared_parts(arg)] if mask.op == "and" else []

    def word(self, root: Node) -> Node:
        return super().word(self.split_masks.get(id(root), root))

    # Guards and movements

    def then(self, guard: Guard) -> None:
        """The body of a guard: planes that only move do so in place; the rest stays in a guard."""
        when = tuple(self.renamed(node) for node in guard.when)
        forgets = [statement for statement in guard.body if isinstance(statement, Forget)]
        outs = [out for one in guard.body if isinstance(one, Compute) for out in one.outs]
        kept = {var.name: value for var, value in self.kept(guard)}
        carried = self.carried(outs, kept)
        moved = {id(out.value) for out in carried}
        others = [out for out in outs if id(out.value) not in moved]
        first = any(id(node) in moved for out in others for node in walk(out.value))
        inner: list[Statement] = [*forgets]
        if others:
            inner.append(Compute(tuple(others), guard.place))
        keeps = tuple((out.var, kept[out.var.name]) for out in others)
        if first:
            self.move(carried, kept, guard.place)
        if inner:
            body = self.block(inner, frozenset(var.name for var, _ in keeps))
            self.emit(Guard(when, tuple(body), keeps, guard.place))
        if not first:
            self.move(carried, kept, guard.place)

    def carried(self, outs: list[Out], kept: dict[str, Node]) -> list[Out]:
        """Writes that move their slot's old value, all with the same movers and offset."""
        found: list[Out] = []
        for out in outs:
            node = out.value
            if not is_movement(node) or node.args[0] is not kept[out.var.name]:
                continue
            if not self.have(node.args[1]) or not _leaves_simply(node):
                continue
            first = found[0].value if found else node
            if (node.op, node.attr, node.args[1]) == (first.op, first.attr, first.args[1]):
                found.append(out)
        return found

    def move(self, carried: list[Out], kept: dict[str, Node], place: str) -> None:
        if not carried:
            return
        first = carried[0].value
        movers = self.variable(first.args[1])
        planes = []
        for out in carried:
            content, _, rest = out.value.args
            old = self.renamed(kept[out.var.name])
            leaves = old
            if rest is not content:
                gone = self.graph.node("not", FLAG, (movers,)) if rest.op == "and" else movers
                leaves = self.graph.node(rest.op, FLAG, (old, gone))
            planes.append(Carried(out.var, old, leaves))
        self.emit(Move(first.op, first.attr, movers, tuple(planes), place))
        self.known |= {id(out.value): out.var for out in carried}

    # What must be stored

    def needs(self, node: Node) -> list[Node]:
        if self.have(node):
            return []
        if is_movement(node):
            return [arg for arg in node.args if not self.have(arg)]
        if chain := chain_of(node, self.have):
            parts = [part for choice in chain for part in self.cell_needs(choice.args[1])]
            masks = [choice.args[0] for choice in chain]
            ids = set(map(id, chain))
            found = [*masks, *parts, chain[-1].args[2]]
            return [need for need in found if not self.have(need) and id(need) not in ids]
        return super().needs(node)

    def stands_apart(self, part: Node, node: Node) -> bool:
        """Long chains of choices are applied before the loop that reads them."""
        return part is not node and not _is_kept(node, self.found) and bool(chain_of(part, self.have))

    def word_needs(self, node: Node) -> list[Node]:
        found: dict[int, Node] = {}
        seen: set[int] = set()
        stack = [node]
        while stack:
            top = stack.pop()
            if id(top) in seen or self.have(top) or top.op in UNIFORM:
                continue
            seen.add(id(top))
            if of_floats(top) or (is_movement(top) and top is not node):
                found[id(top)] = top
            elif top.op == "shift":
                source = top.args[0]
                _, dx, wraps = top.attr
                if self.have(source) or (is_constant(source) and wraps):
                    continue
                if wraps and self.is_again(source, dx):
                    stack.append(source)
                else:
                    found[id(source)] = source
            else:
                stack.extend(top.args)
        return list(found.values())

    def is_again(self, source: Node, dx: int) -> bool:
        """Whether a flag is recomputed at a neighbor. What is read at one neighbor only would fill a plane for it alone."""
        most = self.costs.gates
        if self.askers.get(id(source), 1) == 1:
            most += ONLY_READER
        elif dx:
            return False
        return abs(dx) <= 1 and gate_cost(source, self.have) <= most

    def store(
        self, floats: list[Node], flags: list[Node], pairs: Pairs, place: str, when: Node | None
    ) -> None:
        laid = [node for node in floats if chain_of(node, self.have)]
        moves = [node for node in flags if is_movement(node)]
        if laid:
            self.lay(pairs(laid), place)
        for group in _apart([node for node in floats if node not in laid]):
            self.cells(pairs(group), place)
        if flags := [node for node in flags if node not in moves]:
            self.words(pairs(flags), place, when)
        together: dict[tuple[str, Offset, Node], list[Carried]] = {}
        for var, node in pairs(moves):
            content, movers, rest = (self.variable(arg) for arg in node.args)
            together.setdefault((node.op, node.attr, movers), []).append(Carried(var, content, rest))
            self.known[id(node)] = var
        for (op, offset, movers), planes in together.items():
            self.emit(Move(op, offset, movers, tuple(planes), place))

    def lay(self, pairs: Sequence[tuple[Var, Node]], place: str) -> None:
        """Loops for chains of choices; chains with the same masks share one."""
        groups: dict[tuple[int, ...], list[tuple[Var, Node]]] = {}
        for var, node in pairs:
            chain = chain_of(node, self.have)
            groups.setdefault(tuple(id(choice.args[0]) for choice in chain), []).append((var, node))
        for group in groups.values():
            self.cells(group, place, "choices")


def _apart(floats: Sequence[Node]) -> list[list[Node]]:
    """Values that are computed in loops of their own: they share no operations, and their choices ask other masks."""
    groups: list[tuple[set[object], list[Node]]] = []
    for node in floats:
        parts = [part for part in walk(node) if part.args]
        keys: set[object] = {id(part) for part in parts if of_floats(part)}
        keys.add(("masks", frozenset(id(part.args[0]) for part in parts if part.op == "select")))
        same = [group for group in groups if group[0] & keys]
        groups = [group for group in groups if not group[0] & keys]
        merged = [one for _, nodes in same for one in nodes]
        groups.append((keys.union(*(old for old, _ in same)), [*merged, node]))
    order = {id(node): number for number, node in enumerate(floats)}
    return sorted(
        (sorted(nodes, key=lambda node: order[id(node)]) for _, nodes in groups),
        key=lambda nodes: order[id(nodes[0])],
    )


def _leaves_simply(node: Node) -> bool:
    """Whether cells that movers left become all zeros, all ones, or swapped, and arrivals move at most one row."""
    content, movers, rest = node.args
    if node.op == "arrive" and abs(node.attr[0]) > 1:
        return False
    if rest is content:
        return True
    if node.op == "swap" or rest.op not in ("and", "or"):
        return False
    other = next((arg for arg in rest.args if arg is not content), None)
    if content not in rest.args or other is None:
        return False
    return other is movers if rest.op == "or" else other.op == "not" and other.args[0] is movers


def _conjunctions(node: Node) -> Iterator[Node]:
    """A mask and its nested conjuncts."""
    yield node
    if node.op == "and":
        for arg in node.args:
            yield from _conjunctions(arg)
