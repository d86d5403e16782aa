"""Loops over cells as C++: world by world, row by row, as many floats at a time as a vector holds. Rows outside the region are skipped."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from powderdsl.ir.ops import REAL, Node
from powderdsl.schedule.types import Compute, Guard, Out, Schedule, Sweeps, flat, in_order, ordered, values_of
from powderdsl.targets.cpp.chunks import Chunks
from powderdsl.targets.layout import Layout

SIDE_BY_SIDE = 8
"""The masks of a loop begin at a multiple of this many words: the most that a vector has."""

ANY_PASS = 1 << 30
"""A field is read as far as any pass reads its slot."""

AT_ONCE = 4
"""Choices that are skipped together: whether one of them chooses something is hard to predict."""


def reaches_of(schedule: Schedule) -> dict[str, int]:
    """How many columns of each field are read beyond the edges; ANY_PASS for fields that slots may get."""
    found = {str(node.attr): ANY_PASS for _, node in schedule.leaves if node.op == "load"}
    copies: list[tuple[str, Node]] = []  # a field whose rows may be those of another one
    for statement in flat(schedule.body):
        for node in ordered(values_of(statement)):
            if node.op == "shift" and node.type == REAL and node.attr[2]:
                name = str(node.args[0].attr)
                found[name] = max(found.get(name, 0), abs(node.attr[1]))
        match statement:
            case Guard(_, _, keeps):
                copies += [(var.name, value) for var, value in keeps]
            case Sweeps(loops):
                for out in (out for loop in loops for out in loop.outs):
                    copies += [(out.var.name, _base(out.value))]
                    copies += [(out.var.name, out.otherwise)] if out.otherwise is not None else []
    for _ in copies:
        before = dict(found)
        for name, old in copies:
            if old.op == "load" and old.type == REAL:
                found[str(old.attr)] = max(found.get(str(old.attr), 0), found.get(name, 0))
        if found == before:
            break
    return found


def _base(value: Node) -> Node:
    while value.op == "select":
        value = value.args[2]
    return value


def sweeps_text(sweeps: Sweeps, declared: frozenset[str], layout: Layout, reaches: Mapping[str, int]) -> str:
    """The text of one loop over lanes (worlds).

    Lanes that are strips of one world read each other: a loop that reads other rows of an earlier loop follows it block
    by block, see EACH_BLOCK in fields.hpp.
    """
    over = {out.var.name: out.into for loop in sweeps.loops for out in loop.outs if out.into is not None}
    before, turns, rows, after = [], [], [], []
    turned = 0
    used: set[str] = set()
    for part, loop in zip(sweeps.parts, sweeps.loops, strict=True):
        printed = _Loop(loop, layout, turned, reaches)
        before.append(printed.before(over))
        here = f"if (!strips || part == {part}) " if sweeps.parts[-1] else ""
        if loop.over == "choices":
            turns.append(here + printed.turns())
            turned += -(-len(printed.masks()) // SIDE_BY_SIDE) * SIDE_BY_SIDE
        rows.append(here + printed.rows())
        after.append(printed.after())
        used |= printed.fields
    lasting = {_first(name, over) for name in in_order(used) if name not in sweeps.passing}
    places = " ".join(
        f"const int l{name} = {'l' if _first(name, over) in lasting else 'l & strips'};"
        for name in in_order(used)
    )
    layout.turned = max(layout.turned, turned)
    blocks = f"EACH_BLOCK({sweeps.parts[-1]})"
    inner = "\n".join(rows)
    loop_text = "\n".join(
        [
            *before,
            f"{blocks} {{",
            *turns,
            f"for (int l = 0; l < c.lanes; l++) {{ {places}",
            inner,
            "} }",
            *after,
        ]
    )
    outs = [out for loop in sweeps.loops for out in loop.outs]
    declares = " ".join(
        f"{'Field' if out.var.type == REAL else 'Plane'}* {out.var.name};"
        for out in outs
        if out.var.name not in declared
    )
    written = {out.var.name for out in outs}
    if any(loop.region is None or _keeps(loop) for loop in sweeps.loops):
        return f"{declares}\n{{\n{loop_text}\n}}"
    asked = dict.fromkeys(
        question for loop in sweeps.loops for name, question in _asked(loop) if name not in written
    )
    quiet = " ".join(f"{out.var.name} = {out.into or f'keep({_quiet(out)})'};" for out in outs)
    return f"{declares}\nif ({' && '.join(asked) or 'true'}) {{ {quiet} }} else {{\n{loop_text}\n}}"


def _first(name: str, over: dict[str, str]) -> str:
    """The field at the end of a chain of replacements."""
    while name in over:
        name = over[name]
    return name


def _keeps(loop: Compute) -> bool:
    """Whether values outside the region are the old ones."""
    return any(out.otherwise is not None and out.otherwise.op == "load" for out in loop.outs)


def _parts(region: Node) -> list[Node]:
    """The flags of which one must hold."""
    if region.op == "or":
        return [part for arg in region.args for part in _parts(arg)]
    return [] if region.op == "const" else [region]


def _asked(loop: Compute) -> Iterator[tuple[str, str]]:
    """Tests of fields and planes, with their names; if all are true, the loop does nothing."""
    assert loop.region is not None
    for part in _parts(loop.region):
        if part.op == "live":
            yield part.args[0].attr, f"{part.args[0].attr}->still"
        else:
            yield part.attr, f"{part.attr}->zero"


def _quiet(out: Out) -> str:
    if out.var.type == REAL:
        return "c.calm"
    return "c.everything" if out.otherwise is not None and out.otherwise.attr else "c.nothing"


class _Loop:
    """One loop over the rows of a world."""

    def __init__(self, loop: Compute, layout: Layout, turned: int, reaches: Mapping[str, int]):
        self.loop, self.layout, self.first, self.reaches = loop, layout, turned, reaches
        self.fields: set[str] = {out.var.name for out in loop.outs if out.var.type == REAL}
        self.floats = [out for out in loop.outs if out.var.type == REAL]
        self.flags = [out for out in loop.outs if out.var.type != REAL]
        if loop.over == "choices":
            self.text = "\n".join(self.laid())
        else:
            self.text = self.swept()

    def reach(self, name: str) -> int | str:
        """How far columns of a field are read beyond the edges."""
        reach = self.reaches.get(name, 0)
        return "REACH" if reach == ANY_PASS else reach

    def before(self, over: dict[str, str]) -> str:
        lines = []
        for out in self.loop.outs:
            name = out.var.name
            if out.var.type == REAL:
                lines.append(f"{name} = {over.get(name, 'take_field(c)')}; bool some{name} = false;")
                lines.append(
                    f"for (int l = c.lanes; l < LANES; l++) memset({name}->live + l * height, 0, height);"
                )
            else:
                lines.append(f"{name} = take(c);")
                lines.append(
                    f"for (int l = c.lanes; l < LANES; l++) for (int i = 0; i < height * words; i++) "
                    f"((u64*){name}->data)[i * LANES + l] = 0;"
                )
        return "\n".join(lines)

    def turns(self) -> str:
        masks = self.masks()
        return (
            f"{{ const Plane* const all[] = {{{', '.join(masks)}}}; "
            f"turn_masks(c, all, {len(masks)}, {self.first}, first, last); }}"
        )

    def rows(self) -> str:
        if self.loop.over == "choices":
            return f"{{\n{self.text}\n}}"
        return f"for (int y = first; y < last; y++) {{\n{self.text}\n}}"

    def after(self) -> str:
        ends = [f"{out.var.name}->still = !some{out.var.name};" for out in self.floats]
        return " ".join([*ends, *(f"close_plane(c, {out.var.name});" for out in self.flags)])

    # Values, chunk by chunk

    def swept(self) -> str:
        """The body of a loop over rows."""
        values = Chunks(self.layout, self.loop.outs)
        found = [(out, values.of(out.value)) for out in self.loop.outs]
        values.close()
        self.fields |= values.fields
        starts, stores, ends = [], [], []
        for out, value in found:
            name = out.var.name
            if out.var.type == REAL:
                starts.append(
                    f"float* o{name} = {name}->data + ((size_t)l{name} * height + y) * c.g.stride + HALO; I n{name} = {{}};"
                )
                stores.append(
                    f"{{ const F o = {value}; *(Fu*)(o{name} + x) = o; n{name} |= (I)blend(inside, o, splatf(0)); }}"
                )
                ends.append(
                    f"finish_row<{self.reach(name)}>(c, o{name}); {{ const bool some = any((V)(n{name} + n{name})); "
                    f"{name}->live[l{name} * height + y] = some; some{name} |= some; }}"
                )
            else:
                starts.append(f"if (!WORDS) ((u64*){name}->data)[(y * words + words - 1) * LANES + l] = 0;")
                stores.append(
                    f"{{ const u32 o = {value}; put_bits((u64*){name}->data + (y * words + w) * LANES + l, x, o); }}"
                )
        rows = [f"const float* {name} = {call};" for call, name in values.rows.items()]
        words = [
            f"const u64 {name} = ((const u64*){plane}->data)[(y * words + w) * LANES + l];"
            for plane, name in values.words.items()
        ]
        return "\n".join([
            self.skipped(), " ".join([*rows, *starts]), f"for (int w = 0; w < words; w++) {{ {' '.join(words)}",
            "EACH_CHUNK { const u32 inside = inside_of(x, width); (void)inside;",
            *values.lines, *stores, "} }", " ".join(ends),
        ])  # fmt: skip

    def skipped(self) -> str:
        """The text that skips a row outside the region."""
        region = self.loop.region
        if region is None:
            return ""
        parts = _parts(region)
        planes = [str(part.attr) for part in parts if part.op == "load"]
        quiet = []
        if _keeps(self.loop):
            scan = " | ".join(f"((const u64*){plane}->data)[(y * words + w) * LANES + l]" for plane in planes)
            for out in self.loop.outs:
                assert out.otherwise is not None
                name, old = out.var.name, out.otherwise.attr
                self.fields.add(str(old))
                quiet.append(f"some{name} |= copy_row(c, {name}, {old}, l, y);")
            return (
                f"{{ u64 some = 0; for (int w = 0; w < words; w++) some |= {scan or 0}; "
                f"if (!some) {{ {' '.join(quiet)} continue; }} }}"
            )
        for out in self.loop.outs:
            name = out.var.name
            if out.var.type == REAL:
                quiet.append(f"{name}->live[l{name} * height + y] = 0;")
            else:
                rest = "c.valid(w)[l]" if out.otherwise is not None and out.otherwise.attr else "0"
                word = f"((u64*){name}->data)[(y * words + w) * LANES + l] = q;"
                quiet.append(f"for (int w = 0; w < words; w++) {{ const u64 q = {rest}; {word} }}")
        busy = " || ".join(self.busy(part) for part in parts if part.op == "live") or "false"
        scan = " ".join(f"some |= row_bits({plane}, y * words, words, l);" for plane in planes)
        return (
            f"{{ u64 some = ({busy}); if (!some) {{ {scan} }} if (!some) {{ {' '.join(quiet)} continue; }} }}"
        )

    def busy(self, live: Node) -> str:
        """Whether a field has anything in a row."""
        name, dy = str(live.args[0].attr), live.attr[0]
        self.fields.add(name)
        return f"{name}->live[{f'c.line(l{name}, y + {dy})' if dy else f'l{name} * height + y'}]"

    # Chains of choices

    def chains(self) -> list[list[Node]]:
        chains = []
        for out in self.loop.outs:
            chain, node = [], out.value
            while node.op == "select":
                chain.append(node)
                node = node.args[2]
            chains.append(chain)
        return chains

    def masks(self) -> list[str]:
        return [str(choice.args[0].attr) for choice in reversed(self.chains()[0])]

    def laid(self) -> Iterator[str]:
        """A row of all choices: 64 columns stay in registers while the choices whose masks hold there are applied."""
        chains, masks = self.chains(), self.masks()
        names = [out.var.name for out in self.loop.outs]
        count = len(masks)
        bases = [str(chain[-1].args[2].attr) for chain in chains]
        self.fields |= set(bases)
        values = Chunks(self.layout, ())
        levels = []
        for level in range(count):
            at = count - 1 - level
            values.lines, values.known = [], {}
            values.known |= {
                id(chain[at].args[2]): f"g{name}[k]" for chain, name in zip(chains, names, strict=True)
            }
            found = [values.of(chain[at].args[1]) for chain in chains]
            changes = [
                f"g{name}[k] = blend(bits, {value}, g{name}[k]);"
                for name, value in zip(names, found, strict=True)
            ]
            lines = " ".join([*values.lines, *changes])
            levels.append(
                f"{{ const u64 m = masks[{level}]; "
                f"EACH_REGISTER {{ const u32 bits = m >> (x & 63) & ALL; {lines} }} }}"
            )
        self.fields |= values.fields
        yield "for (int y = first; y < last; y++) {"
        yield f"const u64* turned = turned_row(c, l, y - first) + {self.first}; const bool any = any_turned(c, turned, {count});"
        for name, base in zip(names, bases, strict=True):
            kept = f"{name}->live[l{name} * height + y] = any || {base}->live[l{base} * height + y]"
            yield f"some{name} |= {kept};"
        rests = " ".join(
            f"if ({name}->live[l{name} * height + y]) copy_floats(c.g, row_of(c, {name}, l{name}, y), row_of(c, {base}, l{base}, y));"
            for name, base in zip(names, bases, strict=True)
        )
        yield f"if (!any) {{ {rests} continue; }}"
        yield " ".join(f"float* o{name} = row_of(c, {name}, l{name}, y);" for name in names)
        yield " ".join(
            f"const float* b{name} = real_row(c, {base}, l{base}, y);"
            for name, base in zip(names, bases, strict=True)
        )
        yield " ".join(f"const float* {name} = {call};" for call, name in values.rows.items())
        yield "for (int w = 0; w < words; w++) { const u64* masks = turned + w * c.masks;"
        yield " ".join(f"F g{name}[64 / CHUNK];" for name in names)
        yield f"EACH_REGISTER {{ {' '.join(f'g{name}[k] = load(b{name}, x);' for name in names)} }}"
        for begin in range(0, count, AT_ONCE):
            some = " | ".join(f"masks[{level}]" for level in range(begin, min(count, begin + AT_ONCE)))
            yield f"if ({some}) {{ {' '.join(levels[begin : begin + AT_ONCE])} }}"
        yield f"EACH_REGISTER {{ {' '.join(f'*(F*)(o{name} + x) = g{name}[k];' for name in names)} }} }}"
        yield f"{' '.join(f'finish_row<{self.reach(name)}>(c, o{name});' for name in names)} }}"
