"""Passes as values: equal where they are the same but for the identity of their nodes."""

from __future__ import annotations

from hashlib import sha256

from powderdsl.ir.ops import Node, PassGraph, nodes_of


def structure(pass_: PassGraph, *, places: bool = True) -> bytes:
    """A digest that is equal for two passes only if every stage makes the same of both.

    Args:
        places: whether they are also written in the same places, which messages and listings name.
    """
    numbers: dict[int, int] = {}
    rows: list[object] = []
    for node in nodes_of(pass_):
        numbers[id(node)] = len(rows)
        args = tuple([numbers[id(arg)] for arg in node.args])
        rows.append((node.op, node.type, args, node.attr, node.index, node.places if places else ()))

    def named(pairs: tuple[tuple[str, Node], ...]) -> object:
        return tuple((name, numbers[id(node)]) for name, node in pairs)

    substeps = tuple(
        (one.label, one.place if places else "", named(one.writes), tuple(numbers[id(n)] for n in one.guards))
        for one in pass_.substeps
    )
    whole = pass_.name, pass_.pack, substeps, named(pass_.outputs), rows
    return sha256(repr(whole).encode()).digest()
