"""IR on bit planes → the first schedule: one guard per substep, nothing shared between statements."""

from __future__ import annotations

from powderdsl.ir.ops import Graph, Node, PassGraph, SubstepGraph, Type, nodes_of
from powderdsl.schedule.types import (
    Compute,
    Guard,
    Namer,
    Out,
    Schedule,
    Statement,
    Var,
    load,
    over_variables,
)


def lower(pass_: PassGraph) -> Schedule:
    """The schedule of a pass on bit planes.

    A substep changes nothing if its masks hold nowhere, so its writes stand in a guard that keeps the old values.
    Writes without an old value (the first one of a scratch field) are computed unconditionally.
    """
    lowering = _Lowering(pass_)
    for step in pass_.substeps:
        lowering.substep(step)
    lowering.compute([node for _, node in pass_.outputs])
    leaves = tuple((slot, lowering.value(node)) for slot, node in pass_.outputs)
    return Schedule(pass_.name, tuple(lowering.finds.items()), tuple(lowering.body), leaves, lowering.graph)


class _Lowering:
    def __init__(self, pass_: PassGraph):
        self.graph = Graph()
        self.namer = Namer()
        self.body: list[Statement] = []
        self.finds: dict[str, Var] = {}
        self.vars: dict[int, Var] = {}
        """The variable of each node of the pass, by the node's id."""
        self.current: dict[str, Node | None] = {}
        """The current value of each slot: a node of the pass, or None if nothing reads it."""
        self.alive = {id(node) for node in nodes_of(pass_, substeps=False)}
        self.kept = {slot: node.type for slot, node in pass_.outputs}
        """Slots of the state that the pass changes; the other slots that it writes are scratch."""

    def substep(self, step: SubstepGraph) -> None:
        new = [(slot, node) for slot, node in step.writes if id(node) in self.alive and self.missing(node)]
        guards = [node for node in dict.fromkeys(step.guards) if node.op != "const"]
        always = not guards or any(node.op == "const" and node.attr for node in step.guards)
        olds = {id(node): old for slot, node in new if not always and (old := self.old(slot)) is not None}
        self.compute([node for _, node in new if id(node) not in olds], step.place)
        guarded = [node for node in dict.fromkeys(node for _, node in new) if id(node) in olds]
        if guarded:
            self.compute(guards, step.place)
            guarded = [node for node in guarded if self.missing(node)]  # a write may be a mask
        if guarded:
            outer, self.body = self.body, []
            when = tuple(self.value(guard) for guard in guards)
            self.compute(guarded, step.place)
            keeps = tuple((self.vars[id(node)], olds[id(node)]) for node in guarded)
            outer.append(Guard(when, tuple(self.body), keeps, step.place))
            self.body = outer
        for slot, node in step.writes:
            self.current[slot] = node if id(node) in self.alive else None

    def missing(self, node: Node) -> bool:
        return id(node) not in self.vars and node.op not in ("const", "input")

    def old(self, slot: str) -> Node | None:
        """The value of a slot before a substep, if a variable holds it."""
        if slot not in self.current:
            return load(self.graph, self.find(slot, self.kept[slot])) if slot in self.kept else None
        node = self.current[slot]
        return self.value(node) if node is not None and not self.missing(node) else None

    def find(self, slot: str, type: Type) -> Var:
        if slot not in self.finds:
            self.finds[slot] = self.namer.var(type)
        return self.finds[slot]

    def compute(self, nodes: list[Node], place: str = "") -> None:
        """Store nodes in variables, in one statement."""
        wanted = [node for node in dict.fromkeys(nodes) if self.missing(node)]
        if wanted:
            outs = tuple(Out(self.namer.var(node.type, node), self.value(node)) for node in wanted)
            self.body.append(Compute(outs, place))
            self.vars |= {id(out.var.means): out.var for out in outs}

    def value(self, root: Node) -> Node:
        """A node of the pass in terms of the variables defined so far."""
        return over_variables(root, self.graph, self.stored)

    def stored(self, node: Node) -> Node | None:
        if node.op == "input":
            return load(self.graph, self.find(str(node.attr), node.type))
        return load(self.graph, self.vars[id(node)]) if id(node) in self.vars else None
