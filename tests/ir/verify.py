"""The rules that the IR obeys after lowering and after every stage."""

from __future__ import annotations

from powderdsl.ir.ops import FLAG, OPS, Node, Program, nodes_of


class InvalidIR(AssertionError):
    """The compiler made something illegal."""


def demand(holds: bool, message: str) -> None:
    """Raise InvalidIR unless something holds."""
    if not holds:
        raise InvalidIR(message)


def verify(program: Program, after: str) -> None:
    """Raise InvalidIR unless every pass of the program is legal."""
    slots = {slot.name: slot.type for slot in program.slots}
    params = dict(program.params)
    streams = {(name, bits) for name, _, bits in program.streams}
    for pass_ in program.passes:
        seen: dict[object, Node] = {}
        try:
            for node in nodes_of(pass_):
                _verify_node(node)
                key = (node.op, node.type.name, node.args, node.attr)
                demand(seen.setdefault(key, node) is node, f"{node.op} was not interned")
                if node.op == "input":
                    demand(node.attr in slots, f"unknown slot {node.attr}")
                elif node.op == "param":
                    demand(node.attr[0] in params, f"unknown parameter {node.attr}")
                elif node.op in ("below", "draw"):
                    demand(node.attr in streams, f"unknown stream {node.attr}")
            for name, node in pass_.outputs:
                demand(name in slots, f"unknown slot {name}")
                own, type = slots[name], node.type
                demand(type.name == own.name, f"{name} gets a {type}")
                inside = type.name != "int" or own.lo <= type.lo <= type.hi <= own.hi
                demand(inside, f"{name} of {own} gets {type}")
            for step in pass_.substeps:
                demand(all(guard.type == FLAG for guard in step.guards), "a guard is not a flag")
        except InvalidIR as error:
            raise InvalidIR(f"after {after}, pass {pass_.name}: {error}") from None


def _verify_node(node: Node) -> None:
    demand(node.op in OPS, f"unknown operation {node.op}")
    op, alike = OPS[node.op], ""
    wanted = op.args
    if wanted and wanted[0].startswith("*"):
        wanted = (wanted[0][1:],) * len(node.args)
    demand(len(node.args) == len(wanted), f"{node.op} has {len(node.args)} arguments")
    demand(bool(op.attr) == (node.attr is not None), f"{node.op} has the attribute {node.attr!r}")
    for want, arg in zip(wanted, node.args, strict=True):
        kind = arg.type.name
        if want == "=":
            alike = alike or kind
            demand(kind == alike, f"{node.op} mixes {alike} and {kind}")
        else:
            demand(want in ("?", kind), f"{node.op} takes {want}, found {kind}")
    same = not node.args or node.type == op.type_of(node.attr, node.args)
    demand(same and node.type.lo <= node.type.hi, f"{node.op} gives {node.type}")
