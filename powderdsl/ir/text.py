"""Passes as text: a stable printed form for `--emit ir`, golden tests and bug reports, and digests that identify them."""

from __future__ import annotations

from hashlib import sha256

from powderdsl.ir.ops import Node, PassGraph, Program, needed, nodes_of


def print_program(program: Program, only: str | None = None) -> str:
    """All passes (or one) as text: a line per node, the writes of each substep, the slots that the pass changes."""
    lines = [f"program {program.name}"]
    for slot in program.slots:
        note = " resets each step" if slot.resets else ""
        lines.append(f"  slot {slot.name}: {slot.type} = {slot.default:g}{note}")
    for name, kind in program.params:
        lines.append(f"  param {name}: {kind}")
    for name, ident, bits in program.streams:
        lines.append(f"  stream {name}: {bits} bits, hash {ident:#010x}")
    for pass_ in program.passes:
        if only is None or pass_.name == only:
            lines += _pass_lines(pass_)
    return "\n".join(lines) + "\n"


def _pass_lines(pass_: PassGraph) -> list[str]:
    """One pass. Numbers are assigned in order of use, so that they do not depend on nodes that were dropped."""
    names: dict[Node, str] = {}
    lines = [f"pass {pass_.name}"]

    def show(root: Node) -> str:
        for node in needed([root], lambda node: () if node in names else node.args):
            if node in names:
                continue
            parts = [names[arg] for arg in node.args]
            if node.attr is not None:
                parts.append(attr_text(node.attr))
            names[node] = f"%{len(names)}"
            text = f"{node.op} {', '.join(parts)} : {node.type}".replace("  ", " ")
            lines.append(f"    {names[node]} = {text}")
        return names[root]

    for number, step in enumerate(pass_.substeps):
        label = f" ({step.label})" if step.label else ""
        lines.append(f"  substep {number}{label}" + (f"  # {step.place}" if step.place else ""))
        for slot, node in step.writes:
            lines.append(f"    write {slot} = {show(node)}")
    for slot, node in pass_.outputs:
        lines.append(f"  leave {slot} = {show(node)}")
    return lines


def attr_text(attr: object) -> str:
    if isinstance(attr, frozenset):
        return "{" + ", ".join(map(str, sorted(attr))) + "}"
    if isinstance(attr, tuple):
        return "(" + ", ".join(map(attr_text, attr)) + ")"
    return "value" if attr is None else str(attr)


SIGNS = {
    "and": "&", "or": "|", "xor": "^", "add": "+", "sub": "-", "mul": "*", "div": "/", "eq": "==", "lt": "<", "le": "<=",
}  # fmt: skip
"""The operations that are written between their arguments."""


def infix(names: str) -> dict[str, str]:
    """The expressions of some operations in generated code, with the arguments by number."""
    return {name: f"{{0}} {SIGNS[name]} {{1}}" for name in names.split()}


def structure(pass_: PassGraph, *, places: bool = True) -> bytes:
    """A digest that is equal for two passes only if every stage gives equal results for both.

    `places`: also compare the files and lines of rules, which messages and listings name.
    """
    numbers: dict[Node, int] = {}
    rows: list[object] = []
    for node in nodes_of(pass_):
        numbers[node] = len(rows)
        args = [numbers[arg] for arg in node.args]
        rows.append((node.op, node.type, args, node.attr, node.index, node.places if places else ()))

    def numbered(pairs: tuple[tuple[str, Node], ...]) -> object:
        return [(name, numbers[node]) for name, node in pairs]

    substeps = [
        (step.label, step.place if places else "", numbered(step.writes), [numbers[n] for n in step.guards])
        for step in pass_.substeps
    ]
    whole = pass_.name, pass_.pack, substeps, numbered(pass_.outputs), rows
    return sha256(repr(whole).encode()).digest()
