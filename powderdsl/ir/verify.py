"""The rules of legal IR, checked after lowering and after every stage."""

from __future__ import annotations

from powderdsl.ir.ops import FLAG, LEAVES, OPS, Node, PassGraph, Program, nodes_of


class InvalidIR(AssertionError):
    """The compiler made something illegal: a bug of ours, never of a rule file."""


def verify(program: Program, after: str) -> None:
    """Raise InvalidIR unless every pass of the program is legal."""
    slots = {slot.name: slot.type for slot in program.slots}
    params = {name for name, _ in program.params}
    streams = {(name, bits) for name, _, bits in program.streams}
    for pass_ in program.passes:
        try:
            _verify_pass(pass_, slots, params, streams)
        except InvalidIR as error:
            raise InvalidIR(f"after {after}, pass {pass_.name}: {error}") from None


def _verify_pass(pass_: PassGraph, slots: dict, params: set[str], streams: set[tuple[str, int]]) -> None:
    seen: dict[object, Node] = {}
    for node in nodes_of(pass_):
        _verify_node(node)
        key = (node.op, node.type.name, tuple(id(arg) for arg in node.args), node.attr)
        _demand(seen.setdefault(key, node) is node, f"{node.op} was not interned")
        if node.op == "input":
            _demand(node.attr in slots, f"unknown slot {node.attr}")
        elif node.op == "param":
            _demand(node.attr[0] in params, f"unknown parameter {node.attr}")
        elif node.op in ("below", "draw"):
            _demand(node.attr in streams, f"unknown stream {node.attr}")
    for name, node in pass_.outputs:
        _demand(name in slots, f"unknown slot {name}")
        _demand(node.type.name == slots[name].name, f"{name} gets a {node.type}")
        if node.type.name == "int":
            inside = slots[name].lo <= node.type.lo and node.type.hi <= slots[name].hi
            _demand(inside, f"{name} of {slots[name]} gets {node.type}")
    for step in pass_.substeps:
        for guard in step.guards:
            _demand(guard.type == FLAG, "a guard is not a flag")


def _verify_node(node: Node) -> None:
    op = OPS.get(node.op)
    if op is None:
        raise InvalidIR(f"unknown operation {node.op}")
    wanted_args = op.args
    if wanted_args and wanted_args[0].startswith("*"):
        wanted_args = (wanted_args[0][1:],) * len(node.args)
    _demand(len(node.args) == len(wanted_args), f"{node.op} has {len(node.args)} arguments")
    _demand(bool(op.attr) == (node.attr is not None), f"{node.op} has the attribute {node.attr!r}")
    alike: set[str] = set()
    for wanted, arg in zip(wanted_args, node.args, strict=True):
        if wanted == "=":
            alike.add(arg.type.name)
        elif wanted != "?":
            _demand(arg.type.name == wanted, f"{node.op} takes {wanted}, found {arg.type}")
        if wanted != "=" and op.result == "=" and wanted == "?":
            alike.add(arg.type.name)
    _demand(len(alike) <= 1, f"{node.op} mixes {sorted(alike)}")
    if op.result == "=":
        _demand(node.type.name in alike, f"{node.op} of {sorted(alike)} gives {node.type}")
    elif op.result != "?":
        _demand(node.type.name == op.result, f"{node.op} gives {node.type}")
    _demand(node.type.name != "int" or node.type.lo <= node.type.hi, f"{node.op} has an empty range")
    _demand(node.op not in LEAVES or not node.args, f"{node.op} has arguments")


def _demand(holds: bool, message: str) -> None:
    if not holds:
        raise InvalidIR(message)
