"""A stable printed form of the IR, for `--emit ir`, golden tests and bug reports."""

from __future__ import annotations

from powderdsl.ir.ops import Node, PassGraph, Program, ordered


def print_program(program: Program, only: str | None = None) -> str:
    """All passes (or one) as text: a line a node, what each substep writes, what the pass leaves."""
    lines = [f"program {program.name}"]
    for slot in program.slots:
        note = " resets each step" if slot.resets else ""
        lines.append(f"  slot {slot.name}: {slot.type} = {slot.default:g}{note}")
    for name, kind in program.params:
        lines.append(f"  param {name}: {kind}")
    for name, ident, bits in program.streams:
        lines.append(f"  stream {name}: {bits} bits, hash {ident:#010x}")
    lines += [print_pass(pass_) for pass_ in program.passes if only is None or pass_.name == only]
    return "\n".join(lines) + "\n"


def print_pass(pass_: PassGraph) -> str:
    """One pass. Numbers are given in order of use, so that they do not depend on what was built and dropped."""
    names: dict[int, str] = {}
    lines = [f"pass {pass_.name}"]

    def show(root: Node) -> str:
        for node in ordered([root], names):
            names[id(node)] = f"%{len(names)}"
            lines.append(f"    {names[id(node)]} = {_node_text(node, names)}")
        return names[id(root)]

    for number, step in enumerate(pass_.substeps):
        label = f" ({step.label})" if step.label else ""
        lines.append(f"  substep {number}{label}" + (f"  # {step.place}" if step.place else ""))
        for slot, node in step.writes:
            reference = show(node)
            lines.append(f"    write {slot} = {reference}")
    for slot, node in pass_.outputs:
        lines.append(f"  leave {slot} = {show(node)}")
    return "\n".join(lines)


def _node_text(node: Node, names: dict[int, str]) -> str:
    parts = [names[id(arg)] for arg in node.args]
    if node.attr is not None:
        parts.append(attr_text(node.attr))
    return f"{node.op} {', '.join(parts)} : {node.type}".replace("  ", " ")


def attr_text(attr: object) -> str:
    if isinstance(attr, frozenset):
        return "{" + ", ".join(map(str, sorted(attr))) + "}"
    if isinstance(attr, tuple):
        return "(" + ", ".join(attr_text(part) for part in attr) + ")"
    if isinstance(attr, float):
        return f"{attr!r}"
    if attr is None:
        return "value"
    return str(attr)
