"""Choices laid over each other in whole fields, one after the other: each costs time only in rows where it holds."""

from __future__ import annotations

from collections.abc import Callable

from powderdsl.ir.ops import REAL, Node, walk
from powderdsl.targets.cpp.blocks import Lanes
from powderdsl.targets.cpp.loops import is_uniform
from powderdsl.targets.cpp.sweeps import Sweep
from powderdsl.targets.layout import Layout

FEWEST = 3
"""Choices from which a field of their own pays."""


def choices(node: Node, have: Callable[[Node], bool]) -> list[Node]:
    """A long chain of choices, the outermost first, whose values are computed from what is stored; else nothing."""
    chain: list[Node] = []
    while node.op == "select" and node.type == REAL and not have(node):
        if node.args[0].op == "param":
            return []
        chain.append(node)
        node = node.args[2]
    if len(chain) < FEWEST or is_uniform(node):  # what is the same everywhere stands in no field
        return []
    for (
        choice
    ) in chain:  # a choice may build on the one below it, which the row still holds, not on those before
        seen = {id(choice.args[2])}
        stack = [choice.args[1]]
        while stack:
            part = stack.pop()
            if id(part) in seen or have(part):
                continue
            seen.add(id(part))
            if part.op in ("select", "draw") or (part.op == "shift" and reads(part, choice.args[2])):
                return []
            stack.extend(part.args)
    return chain


def reads(node: Node, other: Node) -> bool:
    """Whether a value is computed from another."""
    return any(inner is other for inner in walk(node))


def layer_lanes(
    chains: list[list[Node]],
    names: list[str],
    planes: dict[int, str],
    fields: dict[int, str],
    layout: Layout,
    first: int,
) -> Lanes:
    """The loop body that lays chains with the same masks, whose bases are stored, into new fields.

    `first` numbers the lists of active rows that the masks take: one a choice, and one for all together.
    """
    count = len(chains[0])
    layout.active = max(layout.active, first + count + 1)
    masks = [planes[id(choice.args[0])] for choice in reversed(chains[0])]
    bases = [fields[id(chain[-1].args[2])] for chain in chains]
    takes = " ".join(f"{name} = take_field(c); bool some{name} = false;" for name in names)
    pads = " ".join(
        f"for (int l = c.lanes; l < LANES; l++) memset({name}->live + l * height, 0, height);"
        for name in names
    )
    lists = " ".join(f"active_rows(c, {mask}, {first + i});" for i, mask in enumerate(masks))
    lists += f" active_together(c, {first}, {count});"
    copies = " ".join(
        f"some{name} |= lay_row(c, {name}, l{name}, {base}, l{base}, y, any);"
        for name, base in zip(names, bases, strict=True)
    )
    # A few rows at a time: what they read and write stays in the nearest cache while the choices pass over it.
    body = [
        "for (int from = first; from < last; from += c.near_rows) {",
        f"for (int y = from; y < from + c.near_rows && y < last; y++) {{ const bool any = is_active(c, {first + count}, l, y); {copies} }}",
    ]
    reads = {(base, 0, 0) for base in bases}
    for level in range(count):
        at = count - 1 - level
        layer = Sweep(planes, fields, layout)
        olds = [layer.temporary(f"*(const F*)(o{name} + x)") for name in names]
        for chain, old in zip(chains, olds, strict=True):
            layer.memo[id(chain[at].args[2]), 0, 0] = old
        values = [layer.value(chain[at].args[1]) for chain in chains]
        stores = [
            f"*(F*)(o{name} + x) = blend(bits, {value}, {old});"
            for name, value, old in zip(names, values, olds, strict=True)
        ]
        reads |= layer.reads
        rows = [f"float* o{name} = row_of(c, {name}, l{name}, y);" for name in names]
        rows += [f"const float* {name} = {call};" for call, name in layer.rows.items()]
        body.append(
            f"EACH_ACTIVE({first + level}) {{ {' '.join(rows)}\n"
            f"for (int w = 0; w < words; w++) if (const u64 m = ((const u64*){masks[level]}->data)[(y * words + w) * LANES + l])\n"
            "for (int x = 64 * w; x < 64 * w + 64 && x < width; x += CHUNK) { const u32 bits = m >> (x & 63) & 0xffff;\n"
            f"{' '.join([*layer.lines, *stores])} }} }}"
        )
    finish = " ".join(f"finish_row(c, row_of(c, {name}, l{name}, y));" for name in names)
    body.append(f"EACH_ACTIVE({first + count}) {{ {finish} }}\n}}")
    ends = " ".join(f"{name}->still = !some{name};" for name in names)
    asked = (*(f"{base}->still" for base in bases), *(f"{mask}->zero" for mask in masks))
    outputs = tuple((name, False) for name in names)
    before = f"{takes}\n{pads}\n{lists}"
    return Lanes(outputs, before, "\n".join(body), ends, asked, frozenset(reads), by_row=False)
