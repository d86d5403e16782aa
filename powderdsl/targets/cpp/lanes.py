"""A sweep as C++: for one world `l`, row by row, rows where nothing is going on skipped."""

from __future__ import annotations

from powderdsl.ir.ops import REAL, Node
from powderdsl.targets.cpp.blocks import Lanes
from powderdsl.targets.cpp.sweeps import Sweep, rows_read


def sweep_lanes(
    outputs: list[tuple[Node, str, str]], sweep: Sweep, values: list[float | bool] | None, masks: list[Node]
) -> Lanes:
    """The loop body of a sweep.

    Args:
        outputs: node, variable and chunk value of each field or plane that it fills.
        sweep: the statements of one chunk.
        values: what the outputs are where nothing is going on, None if that is not known.
        masks: flags that must be empty for that.
    """
    takes, row_start, stores, row_end, quiet_row = [], [], [], [], []
    for position, (node, name, value) in enumerate(outputs):
        if node.type == REAL:
            takes.append(f"{name} = take_field(c); bool some{name} = false;")
            row_start.append(
                f"float* o{name} = {name}->data + ((size_t)l{name} * height + y) * c.g.stride + HALO; I n{name} = {{}};"
            )
            stores.append(
                f"{{ const F o = {value}; *(Fu*)(o{name} + x) = o; n{name} |= (I)blend(inside, o, splatf(0)); }}"
            )
            row_end.append(
                f"finish_row(c, o{name}); {{ const bool some = any((V)(n{name} + n{name})); {name}->live[l{name} * height + y] = some; some{name} |= some; }}"
            )
            quiet_row.append(f"{name}->live[l{name} * height + y] = 0;")
        else:
            takes.append(f"{name} = take(c);")
            row_start.append(
                f"if (width & 63) ((u64*){name}->data)[(y * words + words - 1) * LANES + l] = 0;"
            )
            stores.append(
                f"{{ const u32 o = {value}; put_bits((u64*){name}->data + (y * words + w) * LANES + l, x, o); }}"
            )
            rest = bool(values[position]) if values else False
            word = f"((u64*){name}->data)[(y * words + w) * LANES + l] = q;"
            quiet_row.append(
                f"for (int w = 0; w < words; w++) {{ const u64 q = {'c.valid(w)[l]' if rest else '0'}; {word} }}"
            )
    ends = " ".join(
        f"close_plane(c, {name});" if node.type != REAL else f"{name}->still = !some{name};"
        for node, name, _ in outputs
    )
    pads = " ".join(
        f"for (int l = c.lanes; l < LANES; l++) for (int i = 0; i < height * words; i++) ((u64*){name}->data)[i * LANES + l] = 0;"
        if node.type != REAL else f"for (int l = c.lanes; l < LANES; l++) memset({name}->live + l * height, 0, height);"
        for node, name, _ in outputs
    )  # fmt: skip
    rows = " ".join(f"const float* {name} = {call};" for call, name in sweep.rows.items())
    words = [
        f"const u64 {name} = ((const u64*){plane}->data)[(y * words + w) * LANES + l];"
        for plane, name in sweep.words.items()
    ]
    check = ""
    asked: tuple[str, ...] | None = None
    if values is not None:
        read = rows_read([node for node, _, _ in outputs], sweep.have)
        sweep.reads.update((sweep.fields[id(node)], dy, 0) for node, dy, _ in read)
        busy = [_busy(sweep, node, dy, wraps) for node, dy, wraps in read]
        planes = tuple(dict.fromkeys(sweep.planes[id(m)] for m in masks if m.op != "param"))
        scan = " ".join(f"some |= row_bits({plane}, y * words, words, l);" for plane in planes)
        fixed = "true" if any(m.op == "param" for m in masks) else " || ".join(busy) or "false"
        check = f"{{ u64 some = ({fixed}); if (!some) {{ {scan} }} if (!some) {{ {' '.join(quiet_row)} continue; }} }}"
        if not any(m.op == "param" for m in masks):
            still = [f"{sweep.fields[id(node)]}->still" for node, _, _ in read]
            asked = (*still, *(f"{sweep.planes[id(m)]}->zero" for m in masks))
    body = "\n".join([
        f"{check}\n{rows} {' '.join(row_start)}",
        f"for (int w = 0; w < words; w++) {{ {' '.join(words)}",
        "for (int x = 64 * w; x < 64 * w + 64 && x < width; x += CHUNK) {",
        "const u32 inside = width - x >= CHUNK ? 0xffff : (1u << (width - x)) - 1; (void)inside;",
        *sweep.lines, *stores, "} }", " ".join(row_end),
    ])  # fmt: skip
    written = tuple((name, bool(values[i]) if values else False) for i, (_, name, _) in enumerate(outputs))
    return Lanes(written, f"{' '.join(takes)}\n{pads}", body, ends, asked, frozenset(sweep.reads))


def _busy(sweep: Sweep, node: Node, dy: int, wraps: bool) -> str:
    name = sweep.fields[id(node)]
    if dy == 0:
        return f"{name}->live[l{name} * height + y]"
    if wraps:
        return f"{name}->live[c.line(l{name}, y + {dy})]"
    return f"(c.has_line(l{name}, y + {dy}) && {name}->live[l{name} * height + y + {dy}])"
