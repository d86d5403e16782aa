"""IR on planes -> what a kernel does: movements on all their planes at once, choices of reals in place, moments.

The plan of a pass is a graph of the same nodes with a few operations more, which array kernels have and the IR lacks:

``stack`` planes → block; ``swap`` (block, movers) and ``arrive``, ``swap_onto`` (block, movers, rest) → block;
``masked`` (block, flag, plane…) → the block where the flag holds, but for some planes; ``member`` (block) → a plane;
``cells`` (flag) → bool cells; ``choose`` (cells, yes, no) → reals; ``places`` (flag) → where it holds, ``moved``
(places) → their neighbours; ``update`` (places, no, other) → the real `no`, and there `other` added to it, taken off or
multiplied; ``carry`` (places, moved, no, other) → the same at neighbours with what `other` has at the places.

A draw has one argument more, or none: where its result is asked for. ``below_param`` is a draw below a parameter.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from powderdsl.ir.ops import FLAG, REAL, Node, PassGraph, Step, Type, nodes_of

BLOCK, CELLS, PLACES = Type("block"), Type("cells"), Type("places")
FEW = 2
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
        self.steps = [
            (step, writes)
            for step in self.pass_.moments
            if (writes := [w for w in step.writes if id(w[1]) in alive])
        ]
        self.olds: list[dict[str, Node]] = []
        current: dict[str, Node] = {}
        for step, _ in self.steps:
            self.olds.append(dict(current))
            current.update(step.writes)
        self.written = {id(node): (i, slot) for i, (_, ws) in enumerate(self.steps) for slot, node in ws}
        guards = [guard for step, _ in self.steps for guard in step.guards]
        nodes = below([*(node for _, node in self.pass_.outputs), *guards])
        self.users = Counter(id(arg) for node in nodes for arg in node.args)
        self.users.update(id(node) for _, node in self.pass_.outputs)
        user = {id(arg): node for node in nodes for arg in node.args}
        self.asked = {
            id(draw): self._asked(draw, user) for draw in nodes if _draws(draw) and draw.op in _DRAWS
        }
        for group in grouped(
            below([*(node for _, node in self.pass_.outputs), *guards], args=self.needs), self.needs
        ):
            if group[0].op in ("swap", "arrive"):
                self._movement(group)
            else:
                self.new[id(group[0])] = self._rewritten(group[0])

    def of(self, node: Node) -> Node:
        return self.new[id(node)]

    def needs(self, node: Node) -> tuple[Node, ...]:
        """What must be there before a node: for some draws also where they are asked for."""
        return (*node.args, *self.asked.get(id(node), ()))

    def _asked(self, draw: Node, user: Mapping[int, Node]) -> tuple[Node, ...]:
        """Flags without which a draw does not matter: what it is joined to, as far as only this depends on it."""
        found: list[Node] = []
        node = draw
        while self.users[id(node)] == 1 and id(node) in user:
            above = user[id(node)]
            if above.op == "and":
                other = above.args[1] if above.args[0] is node else above.args[0]
                found += [other] if not self._is_random(other) else []
            elif above.op not in _POINTWISE:
                break
            node = above
        return tuple(found)

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
        count = self.size[id(block)]
        in_place = all(node.args[0] is node.args[2] for node in group)
        rest = block if in_place else self._rest(group, block, places)
        if rest is None:
            contents = [self.of(node.args[0]) for node in group]
            block, places, count = self._stack(contents), list(range(len(group))), len(group)
            rest = self._stack([self.of(node.args[2]) for node in group])
        if first.op == "swap" and in_place:
            moved = self.make("swap", BLOCK, block, movers, attr=first.attr, like=first)
        else:
            op = "arrive" if first.op == "arrive" else "swap_onto"
            moved = self.make(op, BLOCK, block, movers, rest, attr=first.attr, like=first)
        self.size[id(moved)] = count
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

    def _rest(self, group: list[Node], block: Node, places: list[int]) -> Node | None:
        """What movements find where they leave, as a block: mostly the block where some flag holds."""
        kept: Counter[int] = Counter()
        flags: dict[int, Node] = {}
        for node in group:
            content, _, rest = node.args
            if rest.op == "and" and content in rest.args:
                other = rest.args[1] if rest.args[0] is content else rest.args[0]
                kept[id(other)] += 1
                flags[id(other)] = other
        if not kept or 2 * max(kept.values()) <= len(group):
            return None
        flag = flags[kept.most_common(1)[0][0]]
        others = [
            (place, self.of(node.args[2]))
            for node, place in zip(group, places, strict=True)
            if not (node.args[2].op == "and" and {*node.args[2].args} == {node.args[0], flag})
        ]
        planes = [plane for _, plane in others]
        places_of = tuple(place for place, _ in others)
        return self.make("masked", BLOCK, block, self.of(flag), *planes, attr=places_of)

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
        conditions = () if always else tuple(self._condition(guard) for guard in guards)
        return Moment(step.place, conditions, tuple(found.values()))

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
        if id(node) not in self.random:
            for part in below([node]):
                self.random[id(part)] = _draws(part) or any(self.random[id(arg)] for arg in part.args)
        return self.random[id(node)]


def _draws(node: Node) -> bool:
    """Whether a node takes more than a few random bits."""
    if node.op == "chance":
        _, bits, limit = node.attr
        return bits - ((limit & -limit).bit_length() - 1) > FEW
    return node.op in ("below_planes", "draw")


def _conjuncts(node: Node) -> list[Node]:
    parts, stack = [], [node]
    while stack:
        top = stack.pop()
        if top.op == "and":
            stack.extend(reversed(top.args))
        else:
            parts.append(top)
    return list({id(part): part for part in parts}.values())


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
