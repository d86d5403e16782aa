"""IR on planes -> what a kernel does: movements on all their planes at once, choices of reals in place, moments.

The plan of a pass is a graph of the same nodes with a few operations more, which array kernels have and the IR lacks:

``stack`` planes → block; ``member`` (block) → a plane; ``swap`` (block, movers) → block; ``arrive`` and ``swap_onto``
(block, movers, rest) → block; ``leave`` (block, movers) → the block with the movers gone and arrived;
``cells`` (flag) → bool cells; ``choose`` (cells, yes, no) → reals; ``places`` (flag) → where it holds, ``moved``
(places) → their neighbours; ``update`` (places, no, other) → the real `no`, and there `other` added to it, taken off or
multiplied; ``carry`` (places, moved, no, other) → the same at neighbours with what `other` has at the places.

A draw has one argument more, or none: where its result is asked for. ``below_param`` is a draw below a parameter.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Container, Iterable
from dataclasses import dataclass, field
from typing import Any

from powderdsl.ir.ops import FLAG, REAL, Node, PassGraph, Step, Type, nodes_of

BLOCK, CELLS, PLACES = Type("block"), Type("cells"), Type("places")
FEW_BITS = 2
"""So many random bits are drawn without asking whether they matter."""
MAX_ASKED = 8
"""So many flags, without which a draw does not matter, are kept in mind."""
_UPDATES = ("add", "sub", "mul")
_POINTWISE = ("and", "or", "xor", "not", "select")
_DRAWS = ("chance", "below_planes")


@dataclass(frozen=True)
class Write:
    """What a moment makes, and what stands there if nothing in it holds anywhere."""

    node: Node
    old: Node | None


@dataclass(frozen=True)
class Moment:
    """Writes that change nothing unless one of the conditions holds somewhere; no conditions: always carried out."""

    place: str
    conditions: tuple[Node, ...]
    writes: tuple[Write, ...]


@dataclass(frozen=True)
class Plan:
    """A pass for array kernels. `shared` are the nodes that more than one moment, or a moment and the end, needs."""

    name: str
    moments: tuple[Moment, ...]
    outputs: tuple[tuple[str, Node], ...]
    shared: frozenset[int]


def plan_pass(pass_: PassGraph) -> Plan:
    """The plan of a pass on planes."""
    planner = _Planner(pass_)
    outputs = tuple((slot, planner.of(node)) for slot, node in pass_.outputs)
    moments = planner.moments()
    return Plan(pass_.name, moments, outputs, _shared(moments, outputs))


@dataclass
class _Planner:
    pass_: PassGraph
    made: dict[object, Node] = field(default_factory=dict)
    new: dict[int, Node] = field(default_factory=dict)
    size: dict[int, int] = field(default_factory=dict)
    """Planes of each block."""
    lasting: dict[int, Node] = field(default_factory=dict)
    """Blocks that a moment makes of another block, which is what stands there if nothing moves."""
    random: dict[int, bool] = field(default_factory=dict)

    def __post_init__(self) -> None:
        alive = {id(node) for node in nodes_of(self.pass_, moments=False)}
        self.steps: list[tuple[Step, list[tuple[str, Node]]]] = []
        self.olds: list[dict[str, Node]] = []
        current: dict[str, Node] = {}
        for step in self.pass_.moments:
            writes = [write for write in step.writes if id(write[1]) in alive]
            if writes:
                self.steps.append((step, writes))
                self.olds.append(dict(current))
            current.update(step.writes)  # also what nobody reads: a moment after it may not be left out then
        self.written = {id(node): (i, slot) for i, (_, ws) in enumerate(self.steps) for slot, node in ws}
        roots = [node for _, node in self.pass_.outputs]
        roots += [guard for step, _ in self.steps for guard in step.guards]
        nodes = below(roots)
        self.users = Counter(id(node) for node in (*roots, *(arg for node in nodes for arg in node.args)))
        self.asked = self._asked(nodes, {id(node) for node in roots} | set(self.written))
        for group in grouped(below(roots, args=self.needs), self.needs):
            if group[0].op in ("swap", "arrive"):
                self._movement(group)
            else:
                self.new[id(group[0])] = self._rewritten(group[0])

    def of(self, node: Node) -> Node:
        return self.new[id(node)]

    def needs(self, node: Node) -> tuple[Node, ...]:
        """What must be there before a node: for some draws also where they are asked for."""
        return (*node.args, *self.asked.get(id(node), ()))

    def _asked(self, nodes: list[Node], roots: set[int]) -> dict[int, tuple[Node, ...]]:
        """Flags without which a draw does not matter: those that all it comes to is joined to."""
        where: dict[int, dict[int, Node]] = {}
        for node in reversed(nodes):
            own = {} if id(node) in roots else where.get(id(node), {})
            for arg in node.args:
                if not self._is_random(arg):
                    continue
                flags = dict(own) if node.op in _POINTWISE else {}
                for other in node.args:
                    if node.op == "and" and not self._is_random(other) and len(flags) < MAX_ASKED:
                        flags[id(other)] = other
                known = where.get(id(arg), flags)
                where[id(arg)] = {key: flag for key, flag in known.items() if key in flags}
        draws = [node for node in nodes if node.op in _DRAWS and _draws(node)]
        return {id(draw): tuple(where.get(id(draw), {}).values()) for draw in draws}

    def make(self, op: str, type: Type, *args: Node, attr: Any = None, like: Node | None = None) -> Node:
        key = (op, type.name, tuple(id(arg) for arg in args), repr(attr))
        if key not in self.made:
            self.made[key] = Node(op, type, args, attr, -1, like.places if like else ())
        return self.made[key]

    def cells(self, flag: Node) -> Node:
        return self.make("cells", CELLS, flag)

    def _rewritten(self, node: Node) -> Node:
        args = tuple(self.of(arg) for arg in node.args)
        match node.op:
            case "select" if node.type == REAL:
                return self._choice(node, args)
            case "chance" | "below_planes":
                where = self._joined([self.of(part) for part in self.asked.get(id(node), ())])
                bits = node.attr[1]
                if args and args[0].op == "param":
                    name, view, _ = args[0].attr
                    if [arg.attr for arg in args] == [(name, view, i) for i in range(bits, -1, -1)]:
                        return self.make(
                            "below_param", FLAG, *where, attr=(*node.attr, name, view), like=node
                        )
                return self.make(node.op, FLAG, *args, *where, attr=node.attr, like=node)
        return self.make(node.op, node.type, *args, attr=node.attr, like=node)

    def _choice(self, node: Node, args: tuple[Node, ...]) -> Node:
        """A choice of reals. Where the first alternative is the second changed a little, only that is done there."""
        flag, yes, no = node.args
        other: Node | None = None
        if yes.op in _UPDATES and self.users[id(yes)] == 1:
            left, right = yes.args
            if left is no and right is not no:
                other = right
            elif right is no and left is not no and yes.op != "sub":
                other = left
        if other is not None and other.op == "const" and other.attr == 0.0 and yes.op != "mul":
            return args[2]
        if other is None:
            return self.make("choose", REAL, self.make("cells", CELLS, args[0]), args[1], args[2], like=node)
        if flag.op == other.op == "shift" and flag.attr == other.attr and flag.attr[2]:
            source = self.make("places", PLACES, self.of(flag.args[0]))
            target = self.make("moved", PLACES, source, attr=flag.attr[:2])
            attr = (yes.op, *flag.attr[:2])
            return self.make(
                "carry", REAL, source, target, args[2], self.of(other.args[0]), attr=attr, like=node
            )
        places = self.make("places", PLACES, args[0])
        return self.make("update", REAL, places, args[2], self.of(other), attr=yes.op, like=node)

    # Movements

    def _movement(self, group: list[Node]) -> None:
        """Movements of several planes with the same movers and offset, as one of a block."""
        first = group[0]
        movers = self.of(first.args[1])
        block, places = self._block([self.of(node.args[0]) for node in group])
        left = self._left(group, places)
        if first.op == "swap" and all(node.args[0] is node.args[2] for node in group):
            moved = self.make("swap", BLOCK, block, movers, attr=first.attr, like=first)
        elif first.op == "arrive" and left is not None:
            moved = self.make("leave", BLOCK, block, movers, attr=(*first.attr, left), like=first)
        else:
            op = "arrive" if first.op == "arrive" else "swap_onto"
            block, places = self._stack([self.of(node.args[0]) for node in group]), [*range(len(group))]
            rest = self._stack([self.of(node.args[2]) for node in group])
            moved = self.make(op, BLOCK, block, movers, rest, attr=first.attr, like=first)
        self.size[id(moved)] = self.size[id(block)]
        if self._lasts(group):
            self.lasting[id(moved)] = block
        for node, place in zip(group, places, strict=True):
            self.new[id(node)] = self.make("member", FLAG, moved, attr=place, like=node)

    def _block(self, contents: list[Node]) -> tuple[Node, list[int]]:
        """Planes as a block, and where in it they are: the one they are members of, if they are most of it."""
        blocks = {id(plane.args[0]): plane.args[0] for plane in contents if plane.op == "member"}
        key, block = next(iter(blocks.items()), (0, contents[0]))
        together = len(blocks) == 1 and all(plane.op == "member" for plane in contents)
        if together and key in self.lasting and 2 * len(contents) > self.size[key]:
            return block, [plane.attr for plane in contents]
        return self._stack(contents), list(range(len(contents)))

    def _stack(self, planes: list[Node]) -> Node:
        stack = self.make("stack", BLOCK, *planes)
        self.size[id(stack)] = len(planes)
        return stack

    @staticmethod
    def _left(group: list[Node], places: list[int]) -> tuple[int, ...] | None:
        """The planes that hold where something left, if all others do not hold there; None if it is not as simple."""
        found = []
        for node, place in zip(group, places, strict=True):
            content, movers, rest = node.args
            flag = rest.args[1] if rest.args and rest.args[0] is content else next(iter(rest.args), rest)
            if rest.op == "or" and content in rest.args and flag is movers:
                found.append(place)
            elif not (
                rest.op == "and" and content in rest.args and flag.op == "not" and flag.args[0] is movers
            ):
                return None
        return tuple(found)

    def _lasts(self, group: list[Node]) -> bool:
        """Whether one moment writes all planes of the group, each from what its slot had before."""
        moments = set()
        for node in group:
            if id(node) not in self.written:
                return False
            number, slot = self.written[id(node)]
            moments.add(number)
            old, content = self.olds[number].get(slot), node.args[0]
            if not (old is content or (old is None and content.op == "input" and content.attr == slot)):
                return False
        return len(moments) == 1

    # Moments

    def moments(self) -> tuple[Moment, ...]:
        return tuple(
            self._moment(step, writes, olds)
            for (step, writes), olds in zip(self.steps, self.olds, strict=True)
        )

    def _moment(self, step: Step, writes: list[tuple[str, Node]], olds: dict[str, Node]) -> Moment:
        found: dict[int, Write] = {}
        for slot, node in writes:
            new = self.of(node)
            if new.op == "member" and id(new.args[0]) in self.lasting:
                block = new.args[0]
                found[id(block)] = Write(block, self.lasting[id(block)])
                continue
            old = olds.get(slot)
            before = self.new.get(id(old)) if old is not None else self._input(slot, node)
            found[id(new)] = Write(new, before)
        guards = tuple(guard for guard in step.guards if guard.op != "const")
        always = not guards or any(guard.op == "const" and guard.attr for guard in step.guards)
        conditions = {} if always else {id(node): node for node in map(self._condition, guards)}
        return Moment(step.place, tuple(conditions.values()), tuple(found.values()))

    def _input(self, slot: str, like: Node) -> Node | None:
        """What a slot had when the pass began; nothing for scratch fields, which the pass has made itself."""
        known = {name for name, _ in self.pass_.outputs}
        return self.make("input", like.type, attr=slot) if slot in known else None

    def _condition(self, guard: Node) -> Node:
        """The part of a guard that takes few random bits: where that holds nowhere, no more need be drawn."""
        parts = [part for part in _conjuncts(guard) if not self._is_random(part)]
        if not parts or not self._is_random(guard):
            return self.of(guard)
        return self._joined([self.of(part) for part in parts])[0]

    def _joined(self, flags: list[Node]) -> list[Node]:
        """One flag, that all of some hold; none for none."""
        joined = flags[:1]
        for flag in flags[1:]:
            joined = [self.make("and", FLAG, joined[0], flag)]
        return joined

    def _is_random(self, node: Node) -> bool:
        """Whether a node takes random bits. What moments wrote is there already."""
        if id(node) not in self.random:
            for part in below([node], self.random):
                taken = _draws(part) or any(self.random[id(arg)] for arg in part.args)
                self.random[id(part)] = taken and id(part) not in self.written
        return self.random[id(node)]


def _draws(node: Node) -> bool:
    """Whether a node takes more than a few random bits."""
    if node.op == "chance":
        _, bits, limit = node.attr
        return bits - ((limit & -limit).bit_length() - 1) > FEW_BITS
    return node.op in ("below_planes", "draw")


def _conjuncts(node: Node) -> list[Node]:
    """What must hold for a flag to hold, apart."""
    seen: dict[int, Node] = {}
    stack = [node]
    while stack:
        top = stack.pop()
        if id(top) not in seen:
            seen[id(top)] = top
            stack.extend(reversed(top.args) if top.op == "and" else ())
    return [part for part in seen.values() if part.op != "and"]


def _arguments(node: Node) -> tuple[Node, ...]:
    return node.args


def below(
    roots: Iterable[Node], known: Container[int] = (), args: Callable[[Node], tuple[Node, ...]] = _arguments
) -> list[Node]:
    """Nodes below some roots, arguments first, without what is known by its id and what only that needs."""
    seen: dict[int, Node] = {}
    for root in roots:
        stack = [(root, False)]
        while stack:
            node, ready = stack.pop()
            if ready:
                seen.setdefault(id(node), node)
            elif id(node) not in seen and id(node) not in known:
                stack.append((node, True))
                stack.extend((arg, False) for arg in reversed(args(node)))
    return list(seen.values())


def grouped(nodes: list[Node], args: Callable[[Node], tuple[Node, ...]] = _arguments) -> list[list[Node]]:
    """Nodes in order, movements that can be done together in one group."""
    key_of = {id(n): (n.op, id(n.args[1]), n.attr, n.type.name) for n in nodes if n.op in ("swap", "arrive")}
    depth: dict[int, int] = {}
    for node in nodes:
        depth[id(node)] = max((depth[id(arg)] for arg in args(node)), default=0) + (id(node) in key_of)
    levels: list[dict[object, list[Node]]] = [{} for _ in range(max(depth.values(), default=0) + 1)]
    for node in nodes:
        levels[depth[id(node)]].setdefault(key_of.get(id(node), id(node)), []).append(node)
    # By depth in movements: whatever a group needs lies in lower depths.
    return [
        group for level in levels for group in sorted(level.values(), key=lambda g: id(g[0]) not in key_of)
    ]


def _shared(moments: tuple[Moment, ...], outputs: tuple[tuple[str, Node], ...]) -> frozenset[int]:
    """Nodes that more than one moment needs, or a moment and the outputs. What a moment writes is not gone through."""
    count: Counter[int] = Counter()
    written: set[int] = set()
    for moment in moments:
        roots = [*moment.conditions, *(write.node for write in moment.writes)]
        count.update(_region(roots, written))
        written |= {id(write.node) for write in moment.writes}
    count.update(_region([node for _, node in outputs], written))
    return frozenset(key for key, number in count.items() if number > 1)


def _region(roots: list[Node], stop: set[int]) -> set[int]:
    seen: set[int] = set()
    stack = list(roots)
    while stack:
        node = stack.pop()
        if id(node) not in seen and id(node) not in stop:
            seen.add(id(node))
            stack.extend(node.args)
    return seen
