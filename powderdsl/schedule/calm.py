"""The calm form of a pass: what remains of it where all floats that it reads are zero."""

from __future__ import annotations

from powderdsl.ir.build import Builder
from powderdsl.ir.gates import Gates
from powderdsl.ir.ops import FLAG, OPS, REAL, Node, PassGraph, SubstepGraph, nodes_of
from powderdsl.ir.single import single

WORTH = 0.75
"""A calm form must have at most this share of the pass's nodes."""


def real_inputs(pass_: PassGraph) -> tuple[str, ...]:
    """The float slots that a pass reads."""
    nodes = nodes_of(pass_, substeps=False)
    return tuple(dict.fromkeys(str(n.attr) for n in nodes if n.op == "input" and n.type == REAL))


def calm_pass(pass_: PassGraph) -> PassGraph | None:
    """The pass with zeros for its float inputs; None if that is not much smaller."""
    slots = set(real_inputs(pass_))
    if not slots:
        return None
    build = Builder()
    gates = Gates(build)
    new: dict[int, Node] = {}
    for node in nodes_of(pass_):
        build.place = node.places[0] if node.places else ""
        new[id(node)] = _quiet(node, [new[id(arg)] for arg in node.args], gates)
    substeps = []
    for step in pass_.substeps:
        guards = tuple(guard for guard in (new[id(g)] for g in step.guards) if guard is not gates.no)
        writes = tuple((slot, new[id(node)]) for slot, node in step.writes)
        if guards or not step.guards:
            substeps.append(SubstepGraph(step.label, step.place, writes, guards))
    outputs = []
    for slot, old in pass_.outputs:
        node = new[id(old)]
        unchanged = node.op == "input" and node.attr == slot
        if not unchanged and not (slot in slots and node.op == "const" and not node.attr):
            outputs.append((slot, node))
    quiet = PassGraph(pass_.name, pass_.pack, tuple(substeps), tuple(outputs))
    size, before = (len(nodes_of(graph, substeps=False)) for graph in (quiet, pass_))
    return quiet if size <= WORTH * before else None


def _quiet(node: Node, args: list[Node], gates: Gates) -> Node:
    """A node on folded arguments, folded."""
    build, op, evaluate = gates.build, node.op, OPS[node.op].evaluate
    known = bool(args) and all(arg.op == "const" for arg in args)
    if op == "input" and node.type == REAL:
        return build.real(0.0)
    if known and args[0].type == REAL:
        if evaluate is not None:
            found = evaluate(node.attr, *(single(arg.attr) for arg in args))
            return build.flag(bool(found)) if node.type == FLAG else build.real(found)
        if op == "shift" and (node.attr[2] or not args[0].attr):
            return args[0]
    if op == "select" and args[0].op == "const":
        return args[1] if args[0].attr else args[2]
    if op == "select" and args[1] is args[2]:
        return args[1]
    if node.type == FLAG:
        match op:
            case "not":
                return gates.not_(args[0])
            case "and":
                return gates.and_(*args)
            case "or":
                return gates.or_(*args)
            case "xor":
                return gates.xor(*args)
            case "select":
                return gates.mux(*args)
            case "shift":
                return gates.shift(args[0], node.attr[:2], node.attr[2])
            case "swap" | "arrive" if args[1] is gates.no or (args[0] is args[2] and args[0].op == "const"):
                return args[2]
    return build.make(op, node.type, *args, attr=node.attr)
