"""Loops over cells as C++: world by world, row by row, as many floats at a time as a vector holds. Rows outside the region are skipped."""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from powderdsl.ir.ops import REAL, Node, ordered
from powderdsl.schedule.join import field_reads, keeps
from powderdsl.schedule.types import (
    Compute,
    Out,
    Schedule,
    Sweeps,
    alternatives,
    flat,
    is_zero,
)
from powderdsl.targets.cpp.chunks import Chunks
from powderdsl.targets.layout import Layout
from powderdsl.targets.values import chains_of

SIDE_BY_SIDE = 16
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
        for node in ordered(statement.values()):
            if node.op == "shift" and node.type == REAL and node.attr[2]:
                name = str(node.args[0].attr)
                found[name] = max(found.get(name, 0), abs(node.attr[1]))
        copies += [(var.name, value) for var, value in statement.unchanged()]
    for _ in copies:
        before = dict(found)
        for name, old in copies:
            if old.op == "load" and old.type == REAL:
                found[str(old.attr)] = max(found.get(str(old.attr), 0), found.get(name, 0))
        if found == before:
            break
    return found


@dataclass(frozen=True)
class Rows:
    """The rows of a field that only loops of one part read, where they wait: `depth`, a power of two, of them.

    `bare`: the columns beyond the edges that hold zeros, since no loop reads this field around them; None if one does.
    """

    first: int
    depth: int
    bare: int | None

    def at(self, name: str, dy: int) -> str:
        """The pointer to a row; to zeros if nothing is there."""
        return f"at{name}[(y + {dy}) & {self.depth - 1}]"


def _waiting(sweeps: Sweeps) -> dict[str, Rows]:
    """The rows of passing fields, numbered one after another."""
    lags = {
        out.var.name: lag for loop, lag in zip(sweeps.loops, sweeps.lags, strict=True) for out in loop.outs
    }
    depths = dict.fromkeys(sweeps.passing, 1)
    bare: dict[str, int | None] = dict.fromkeys(sweeps.passing, 0)
    for loop, lag in zip(sweeps.loops, sweeps.lags, strict=True):
        for read in field_reads(loop):
            if (name := read.name) in depths:
                depths[name] = max(depths[name], lag - lags[name] - read.dy + 1)
                around, reach = read.wraps and read.dx, bare[name]
                bare[name] = None if around or reach is None else max(reach, abs(read.dx))
    found: dict[str, Rows] = {}
    count = 0
    for name, depth in depths.items():
        found[name] = Rows(count, 1 << (depth - 1).bit_length(), bare[name])
        count += found[name].depth
    return found


def _ahead(sweeps: Sweeps) -> dict[str, int]:
    """How many rows of each field that is written over are read below the last row, around the edge."""
    found = {out.into: 0 for loop in sweeps.loops for out in loop.outs if out.into is not None}
    for loop in sweeps.loops:
        for read in field_reads(loop):
            if read.name in found and read.wraps:
                found[read.name] = max(found[read.name], read.dy)
    return {name: count for name, count in found.items() if count}


def sweeps_text(sweeps: Sweeps, layout: Layout, reaches: Mapping[str, int]) -> str:
    """The text of one loop over worlds, see EACH_WORLD in fields.hpp."""
    if keeps(sweeps.loops[0]):
        return _changed_text(sweeps.loops[0], layout, reaches)
    waiting = _waiting(sweeps)
    written = {out.var.name for loop in sweeps.loops for out in loop.outs}
    waits = sum(rows.depth for rows in waiting.values())
    before: list[str] = []
    rows: list[str] = []
    turns, after = [], []
    ahead = _ahead(sweeps)
    turned, part = 0, -1
    last = {part: lag for lag, part in sorted(zip(sweeps.lags, sweeps.parts, strict=True))}
    for number, loop in enumerate(sweeps.loops):
        marked = [name for name in _region_planes(loop) if name not in written]
        printed = _Loop(loop, layout, turned, reaches, waiting, ahead=ahead, marks=(number, marked))
        before += printed.before()
        before += _marking(number, marked, layout)
        if loop.over == "choices":
            turns.append(printed.turns())
            turned += -(-len(printed.masks) // SIDE_BY_SIDE) * SIDE_BY_SIDE
        if sweeps.parts[number] != part:
            rows += ["}"] if rows else []
            part = sweeps.parts[number]
            rows.append(f"for (int step = 0; step < rows + {last[part]}; step++) {{")
        rows.append(
            f"if (const int y = step - {sweeps.lags[number]}; (u32)y < (u32)rows) {{\n{printed.text}\n}}"
        )
        gone = " ".join(f"{waiting[name].at(name, 0)} = nothing;" for name in printed.waits)
        if gone and sweeps.lags[number] < last[part]:
            rows.append(f"else if (y >= rows) {{ {gone} }}")
        after.append(printed.after())
    layout.turned = max(layout.turned, turned)
    pointers = " ".join(
        f"const float* at{name}[{own.depth}]; std::fill_n(at{name}, {own.depth}, nothing);"
        for name, own in waiting.items()
    )
    for name, count in ahead.items():
        pointers += f" KEEP_FIRST({name}, {count}, {waits})"
        waits += count
    layout.waiting = max(layout.waiting, waits)
    # In a function of its own, fewer values compete for registers.
    start = "[&]() __attribute__((noinline)) {"
    inside = [
        *before,
        *turns,
        _copies(sweeps.loops, waiting),
        f"EACH_WORLD {{ {pointers}",
        *rows,
        "} }",
        *after,
    ]
    loop_text = "\n".join([start, *inside, "}();"])
    outs = [out for loop in sweeps.loops for out in loop.outs]
    lasting = [out for out in outs if out.var.name not in waiting]
    if any(loop.region is None for loop in sweeps.loops):
        return f"{{\n{loop_text}\n}}"
    asked = dict.fromkeys(
        question for loop in sweeps.loops for name, question in _asked(loop) if name not in written
    )
    quiet = " ".join(f"{out.var.name} = keep({_quiet(out)});" for out in lasting)
    quiet += " ".join(f" give(c, {out.into});" for out in lasting if out.into is not None)
    return f"if ({' && '.join(asked) or 'true'}) {{ {quiet} }} else {{\n{loop_text}\n}}"


def _copies(
    loops: Sequence[Compute], without: Container[str], places: Mapping[str, str] = MappingProxyType({})
) -> str:
    """Copies of the addresses that loops need: a compiler knows that what loops store does not change them."""
    nodes = [node for loop in loops for node in ordered(loop.values()) if node.op == "load"]
    names = [places.get(str(node.attr), str(node.attr)) for node in nodes]
    types = {name: node.type for name, node in zip(names, nodes, strict=True)}
    types |= {out.var.name: out.var.type for loop in loops for out in loop.outs}
    return " ".join(
        f"const Field v{name} = *{name}; (void)v{name};"
        if type == REAL
        else f"V* const v{name} = {name}->data; (void)v{name};"
        for name, type in types.items()
        if name not in without
    )


def _changed_text(loop: Compute, layout: Layout, reaches: Mapping[str, int]) -> str:
    """A loop that changes fields in place, in rows of its region."""
    olds = {out.var.name: str(out.otherwise.attr) for out in loop.outs if out.otherwise is not None}
    places = {out.into: out.var.name for out in loop.outs if out.into is not None}
    marked = _region_planes(loop)
    printed = _Loop(loop, layout, 0, reaches, {}, places, marks=(0, marked))
    lines = []
    for name, old in olds.items():
        value = old if old in places else f"keep({old})"
        lines.append(f"{name} = {value}; bool some{name} = false;")
    asked = " || ".join(dict.fromkeys(f"!{question}" for _, question in _asked(loop))) or "false"
    lines.append(f"if ({asked}) {{ {' '.join(f'own(c, {name});' for name in olds)}")
    lines += _marking(0, marked, layout)
    lines.append(_copies([loop], (), places))
    lines.append(f"EACH_WORLD for (int y = 0; y < rows; y++) {{\n{printed.text}\n}}")
    lines.append(" ".join(f"{name}->still = no_rows_left(c, {name});" for name in olds) + " }")
    return "\n".join(lines)


def _region_planes(loop: Compute) -> list[str]:
    """The planes of a region."""
    if loop.region is None or loop.over == "choices":  # choices test their masks themselves
        return []
    return [str(part.attr) for part in alternatives(loop.region) if part.op == "load"]


def _marking(number: int, planes: Sequence[str], layout: Layout) -> Iterator[str]:
    """Which rows of a loop's planes have anything, found for all lanes at once."""
    if planes:
        layout.marks = max(layout.marks, number + 1)
        layout.marked = max(layout.marked, len(planes))
        yield (
            f"{{ const Plane* const all[] = {{{', '.join(planes)}}}; "
            f"mark_rows(c, {number}, all, {len(planes)}); }}"
        )


def _asked(loop: Compute) -> Iterator[tuple[str, str]]:
    """Tests of fields and planes, with their names; if all are true, the loop does nothing."""
    assert loop.region is not None
    for part in alternatives(loop.region):
        if part.op == "live":
            yield part.args[0].attr, f"{part.args[0].attr}->still"
        else:
            yield part.attr, f"{part.attr}->zero"


def _quiet(out: Out) -> str:
    if out.var.type == REAL:
        return "c.calm"
    return "c.everything" if out.otherwise is not None and out.otherwise.attr else "c.nothing"


class _Loop:
    """One loop over the rows of a world: the text of row y."""

    def __init__(
        self,
        loop: Compute,
        layout: Layout,
        turned: int,
        reaches: Mapping[str, int],
        waiting: Mapping[str, Rows],
        places: Mapping[str, str] = MappingProxyType({}),
        ahead: Mapping[str, int] = MappingProxyType({}),
        marks: tuple[int, Sequence[str]] = (0, ()),
    ):
        """`marks`: the number under which rows of planes are marked, and these planes."""
        self.marks = marks
        self.loop, self.layout, self.first, self.reaches, self.waiting = (
            loop,
            layout,
            turned,
            reaches,
            waiting,
        )
        self.floats = [out for out in loop.outs if out.var.type == REAL]
        self.flags = [out for out in loop.outs if out.var.type != REAL]
        self.waits = [out.var.name for out in self.floats if out.var.name in waiting]
        self.lasts = [out.var.name for out in self.floats if out.var.name not in waiting]
        self.values = Chunks(
            layout, loop.outs, {name: own.at for name, own in waiting.items()}, self.bare, places, ahead
        )
        self.chains: list[list[Node]] = []
        self.masks: list[str] = []
        if loop.over == "choices":
            self.chains = chains_of(loop)
            self.masks = [str(choice.args[0].attr) for choice in reversed(self.chains[0])]
        self.text = "\n".join(self.laid() if loop.over == "choices" else self.swept())

    @property
    def bare(self) -> frozenset[str]:
        """The fields whose rows have zeros beyond the edges."""
        return frozenset(name for name, own in self.waiting.items() if own.bare is not None)

    def before(self) -> Iterator[str]:
        for out in self.floats:
            if (name := out.var.name) in self.lasts:
                field = f"overtaken(c, {out.into})" if out.into else "take_field(c)"
                yield f"{name} = {field}; bool some{name} = false; no_rows(c, {name});"
        for out in self.flags:
            yield f"{out.var.name} = take(c); no_words(c, {out.var.name});"

    def turns(self) -> str:
        return (
            f"{{ const Plane* const all[] = {{{', '.join(self.masks)}}}; "
            f"turn_masks(c, all, {len(self.masks)}, {self.first}); }}"
        )

    def after(self) -> str:
        ends = [f"{name}->still = !some{name};" for name in self.lasts]
        return " ".join([*ends, *(f"close_plane(c, {out.var.name});" for out in self.flags)])

    # Rows that are written

    def starts(self) -> Iterator[str]:
        """Pointers to the rows that the loop writes."""
        for out in self.flags:
            yield f"Word* o{out.var.name} = &lane_word(v{out.var.name}, row * words, lane);"
        for out in self.floats:
            name = out.var.name
            if name in self.waiting:
                own = self.waiting[name]
                yield f"float* o{name} = waiting_row(c, {own.first} + (y & {own.depth - 1})); {own.at(name, 0)} = o{name};"
            else:
                yield f"float* o{name} = row_of(c, v{name}, base + y);"

    def ends(self) -> Iterator[str]:
        """The columns beyond the edges of what the loop has written."""
        for out in self.floats:
            name = out.var.name
            own = self.waiting.get(name)
            reach = self.reaches.get(name, 0)
            if own is not None and own.bare is not None:
                yield f"bare_row<{own.bare}>(c, o{name});" if own.bare else ""
            else:
                yield f"finish_row<{'REACH' if reach == ANY_PASS else reach}>(c, o{name});"

    def quiet(self) -> Iterator[str]:
        """What a row outside the region gets."""
        for out in self.loop.outs:
            name = out.var.name
            if name in self.waiting:
                yield f"{self.waiting[name].at(name, 0)} = nothing;"
            elif out.otherwise is not None and out.otherwise.op == "load":
                continue
            elif out.var.type == REAL:
                yield f"v{name}.live[base + y] = 0;"
            else:
                rest = "c.valid(w)[lane]" if out.otherwise is not None and out.otherwise.attr else "0"
                yield f"for (int w = 0; w < words; w++) lane_word(v{name}, row * words + w, lane) = {rest};"

    # Values, chunk by chunk

    def swept(self) -> Iterator[str]:
        values = self.values
        found = [(out, values.of(out.value)) for out in self.loop.outs]
        values.close()
        stores, counts, lives = [], [], []
        for out, value in found:
            name = out.var.name
            if out.var.type != REAL:
                stores.append(f"put_bits(o{name} + w * LANES, x, {value});")
                continue
            stores.append(f"*(Fu*)(o{name} + x) = {value};")
            if name in self.lasts:
                counts.append(f"I n{name} = {{}};")
                stores.append(f"n{name} |= (I)blend(inside, {value}, splatf(0));")
                lives.append(
                    f"{{ const bool some = any((V)(n{name} + n{name})); v{name}.live[base + y] = some; some{name} |= some; }}"
                )
        region = self.loop.region
        yield PLACE
        if region is not None:
            parts = alternatives(region)
            number, marked = self.marks
            scans = [
                f"some |= row_bits(v{part.attr}, row * words, words, lane);"
                for part in parts
                if part.op == "load" and part.attr not in marked
            ]
            tests = [self.busy(part) for part in parts if part.op == "live"]
            tests += [f"(c.marks[{number} * height + row] >> lane & 1)"] if marked else []
            busy = " || ".join(tests) or "false"
            yield f"Word some = {busy};" + (f" if (!some) {{ {' '.join(scans)} }}" if scans else "")
            yield f"if (!some) {{ {' '.join(self.quiet())} }} else {{"
        yield " ".join([*self.pointers(), *self.starts(), *counts])
        yield from (f"if (!WIDTH) o{out.var.name}[(words - 1) * LANES] = 0;" for out in self.flags)
        words = [
            f"const Word {name} = lane_word(v{plane}, row * words + w, lane);"
            for plane, name in values.words.items()
        ]
        yield f"for (int w = 0; w < words; w++) {{ {' '.join(words)}"
        yield "EACH_CHUNK { const u32 inside = inside_of(x, width); (void)inside;"
        yield from (*values.lines, *stores)
        yield "} }"
        yield " ".join([*self.ends(), *lives, "" if region is None else "}"])

    def pointers(self) -> list[str]:
        return [f"const float* {name} = {call};" for call, name in self.values.rows.items()]

    def busy(self, live: Node) -> str:
        """Whether a field has anything in a row."""
        name, dy = str(live.args[0].attr), live.attr[0]
        if name in self.waiting:
            return f"{self.waiting[name].at(name, dy)} != nothing"
        return f"v{name}.live[base + {f'lines[y + {dy}]' if dy else 'y'}]"

    # Chains of choices

    def laid(self) -> Iterator[str]:
        """A row of all choices: the columns of a word stay in registers while the choices whose masks hold there are applied."""
        values, count = self.values, len(self.masks)
        heads = [f"g{number}" for number in range(len(self.chains))]
        bases = [str(chain[-1].args[2].attr) for chain in self.chains]
        levels = []
        for level in range(count):
            at = count - 1 - level
            values.lines, values.known = [], {}
            for chain, name in zip(self.chains, heads, strict=True):
                values.known[id(chain[at].args[2])] = f"{name}[k]"
            found = [values.of(chain[at].args[1]) for chain in self.chains]
            changes = [
                f"{name}[k] = blend(bits, {value}, {name}[k]);"
                for name, value in zip(heads, found, strict=True)
            ]
            lines = " ".join([*values.lines, *changes])
            levels.append(
                f"{{ const Word m = masks[{level}]; "
                f"EACH_REGISTER {{ const u32 bits = m >> (x & (BITS - 1)) & ALL; {lines} }} }}"
            )
        values.lines = []
        values.known = {id(chain[0]): f"{name}[k]" for chain, name in zip(self.chains, heads, strict=True)}
        stores = [f"*(F*)(o{out.var.name} + x) = {values.of(out.value)};" for out in self.floats]
        ends = " ".join([*values.lines, *stores])
        olds = [values.row(base, 0) for base in bases]
        yield f"const Word* turned = turned_row(c, base + y) + {self.first}; const bool any = any_turned(c, turned, {count});"
        lives = " || ".join(dict.fromkeys(self.alive(base) for base in bases))
        yield " ".join(self.pointers())
        near = " || ".join(f"{name} != nothing" for name in values.rows.values())
        yield f"const bool some = any ? {near if self.only_moves() else 'true'} : {lives};"
        yield " ".join(f"some{name} |= v{name}.live[base + y] = some;" for name in self.lasts)
        gone = " ".join(f"{self.waiting[name].at(name, 0)} = nothing;" for name in self.waits)
        yield f"if (!some) {{ {gone} }} else {{"
        yield " ".join(self.starts())
        yield f"for (int w = 0; w < words; w++) {{ const Word* masks = turned + w * c.masks; const u64 which = which_turned(masks, {count});"
        yield " ".join(f"F {name}[BITS / CHUNK];" for name in heads)
        yield f"EACH_REGISTER {{ {' '.join(f'{name}[k] = load({old}, x);' for name, old in zip(heads, olds, strict=True))} }}"
        for begin in range(0, count, AT_ONCE):
            asked = f"which & {(1 << AT_ONCE) - 1 << begin % 64:#x}ull" if count <= 64 else "which"
            yield f"if ({asked}) {{ {' '.join(levels[begin : begin + AT_ONCE])} }}"
        yield f"EACH_REGISTER {{ {ends} }} }}"
        yield f"{' '.join(self.ends())} }}"

    def only_moves(self) -> bool:
        """Whether all choices are values of fields in other places: they are zero where these fields are."""
        values = [choice.args[1] for chain in self.chains for choice in chain]
        return all(node.op in ("shift", "load") or is_zero(node) for node in ordered(values))

    def alive(self, name: str) -> str:
        return (
            f"{self.waiting[name].at(name, 0)} != nothing"
            if name in self.waiting
            else f"{name}->live[base + y]"
        )


PLACE = (
    "const int lane = strips ? y / height : l, row = strips ? y - lane * height : y; (void)lane; (void)row;"
)
"""Where the words of row y lie in planes."""
