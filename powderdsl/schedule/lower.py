"""IR on bit planes → the first schedule: one guard per substep, nothing shared between statements."""

from __future__ import annotations

from collections.abc import Iterable

from powderdsl.ir.ops import Graph, Node, PassGraph, SubstepGraph, Type, nodes_of
from powderdsl.schedule.types import ANSWER, Block, Compute, Guard, Namer, Out, Schedule, Statement, Var, load


def lower(pass_: PassGraph) -> Schedule:
    """The schedule of a pass on bit planes.

    A substep changes nothing if its masks hold nowhere, so its writes stand in a guard that keeps the old values.
    Writes without an old value (the first one of a scratch field) are computed unconditionally.
    """
    lowering = _Lowering(pass_)
    for step in pass_.substeps:
        lowering.substep(step)
    lowering.body += lowering.compute(node for _, node in pass_.outputs)
    leaves = tuple((slot, lowering.value(node)) for slot, node in pass_.outputs)
    return Schedule(pass_.name, tuple(lowering.finds.items()), tuple(lowering.body), leaves, lowering.graph)


class _Lowering:
    def __init__(self, pass_: PassGraph):
        self.graph = Graph()
        self.namer = Namer()
        self.body: list[Statement] = []
        self.finds: dict[str, Var] = {}
        self.stored: dict[int, Var] = {}
        """The variable of each node of the pass that has one, by the node's id."""
        self.current: dict[str, Node] = {}
        """The last node that was written to each slot."""
        self.alive = {id(node) for node in nodes_of(pass_, substeps=False)}
        self.kept = {slot: node.type for slot, node in pass_.outputs}
        """Slots of the state that the pass changes; the other slots that it writes are scratch."""

    def substep(self, step: SubstepGraph) -> None:
        guards = [node for node in dict.fromkeys(step.guards) if node.op != "const"]
        always = not guards or any(node.op == "const" and node.attr for node in step.guards)
        free: list[Node] = []
        guarded: dict[Node, Node] = {}
        """By node that is written: the slot's old value."""
        for slot, node in step.writes:
            if id(node) in self.alive and self.missing(node):
                if always or (old := self.old(slot)) is None:
                    free.append(node)
                else:
                    guarded[node] = old
        self.body += self.compute((node for node in free if node not in guarded), step.place)
        if guarded:
            self.body += self.compute(guards, step.place)
            guarded = {node: old for node, old in guarded.items() if self.missing(node)}  # it may be a mask
        if guarded:
            when = self.graph.node("some", ANSWER, tuple(map(self.value, guards)))
            body = self.compute(guarded, step.place)
            outs = tuple(Out(self.stored[id(node)], old, old) for node, old in guarded.items())
            self.body.append(Guard(outs, step.place, when=when, body=body))
        self.current |= dict(step.writes)

    def missing(self, node: Node) -> bool:
        return id(node) not in self.stored and node.op not in ("const", "input")

    def old(self, slot: str) -> Node | None:
        """The value of a slot before a substep, if a variable holds it."""
        if (node := self.current.get(slot)) is None:
            return load(self.graph, self.find(slot, self.kept[slot])) if slot in self.kept else None
        return self.value(node) if id(node) in self.alive and not self.missing(node) else None

    def find(self, slot: str, type: Type) -> Var:
        if slot not in self.finds:
            self.finds[slot] = self.namer.var(type)
        return self.finds[slot]

    def compute(self, nodes: Iterable[Node], place: str = "") -> Block:
        """The statement that stores nodes in variables."""
        missing = [node for node in dict.fromkeys(nodes) if self.missing(node)]
        outs = tuple(Out(self.namer.var(node.type, node), self.value(node)) for node in missing)
        self.stored |= {id(out.var.means): out.var for out in outs}
        return (Compute(outs, place),) if outs else ()

    def value(self, root: Node) -> Node:
        """A node of the pass in terms of the variables defined so far."""
        done: dict[int, Node] = {}
        stack = [(root, False)]
        while stack:
            node, ready = stack.pop()
            if id(node) in done:
                continue
            if id(node) in self.stored:
                done[id(node)] = load(self.graph, self.stored[id(node)])
            elif node.op == "input":
                done[id(node)] = load(self.graph, self.find(str(node.attr), node.type))
            elif ready:
                args = tuple([done[id(arg)] for arg in node.args])
                done[id(node)] = self.graph.node(node.op, node.type, args, node.attr)
            else:
                stack.append((node, True))
                stack.extend((arg, False) for arg in reversed(node.args))
        return done[id(root)]
