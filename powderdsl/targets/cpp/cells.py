"""Loops over cells as C++: world by world, row by row, one vector of floats at a time, in rows of the region."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

from powderdsl.ir.ops import FLAG, REAL, Node, all_ones, ordered, single
from powderdsl.schedule.join import keeps_values
from powderdsl.schedule.rows import ANY_PASS, Rows, chains_of, region_of, rows_of
from powderdsl.schedule.types import Compute, Sweeps, alternatives, is_zero
from powderdsl.targets.layout import NativeLayout, braced, literal, param_key
from powderdsl.targets.printing import FLOATS, CellValues

TURNED = 16
"""The turned masks of a loop begin at a multiple of this many words: the most that a vector has."""

AT_ONCE = 4
"""Choices that are skipped together: a branch for each choice would be hard to predict."""

PLACE = "const int lane = strips > 1 ? l + y / height : l, row = y - (lane - l) * height; (void)lane; (void)row;"  # fmt: skip
"""The lane and the row of planes that contain the words of row y."""

_FLOATS = FLOATS | {
    "eq": "bits_eq({0}, {1})",
    "lt": "bits_lt({0}, {1})",
    "le": "bits_le({0}, {1})",
    "abs": "magnitude({0})",
    "sqrt": "root({0})",
    "clamp": "clamped({0}, {1}, {2}, SNAP)",
}
"""The expression of each operation on floats. Arguments are numbered first, then the attribute's numbers."""


def sweeps_text(sweeps: Sweeps, layout: NativeLayout, reaches: Mapping[str, int]) -> str:
    """The text of one loop over worlds (EACH_WORLD in fields.hpp)."""
    rows = rows_of(sweeps, reaches)
    loops, turned = list[_Loop](), 0
    for number, own in enumerate(rows.loops):
        loops.append(_Loop(number, own, turned, rows, layout))
        turned += -(-len(loops[-1].masks) // TURNED) * TURNED
    if keeps_values(sweeps.body[0]):
        return _in_place(loops[0])
    layout.cover(turned=turned, waiting=rows.waiting)
    depths = [(name, ring.depth) for name, ring in rows.rings.items()]
    pointers = " ".join(f"const float* at{n}[{d}]; std::fill_n(at{n}, {d}, nothing);" for n, d in depths)
    for name, (count, first) in rows.saved.items():
        pointers += f" KEEP_FIRST({name}, {count}, {first})"
    lines = [line for loop in loops for line in loop.before()]
    lines += [loop.turns() for loop in loops if loop.chains]
    lines += [_addresses(rows), f"EACH_WORLD {{ {pointers}"]
    part = -1
    for loop in loops:
        own = loop.loop
        lag, last = own.lag, max(other.lag for other in sweeps.body if other.part == own.part)
        if own.part != part:
            lines += ["}"] if loop.number else []
            part = own.part
            lines.append(f"for (int step = 0; step < rows + {last}; step++) {{")
        lines.append(f"if (const int y = step - {lag}; (u32)y < (u32)rows) {{\n{loop.text()}\n}}")
        if loop.passing and lag < last:
            lines.append(f"else if (y >= rows) {{ {loop.forget_rings()} }}")
    lines += ["} }", *(loop.after() for loop in loops)]
    # In a separate function, fewer values compete for registers.
    text = "\n".join(["[&]() __attribute__((noinline)) {", *lines, "}();"])
    if any(loop.region is None for loop in sweeps.body):
        return f"{{\n{text}\n}}"
    lasting = [out for out in rows.outs if out.var.name not in rows.rings]
    olds = [(out.var.name, out.otherwise) for out in lasting if out.otherwise is not None]
    quiet = " ".join(f"{name} = keep({storage_of(value)});" for name, value in olds)
    quiet += " ".join(f" give(c, {out.into});" for out in lasting if out.into is not None)
    return f"if ({' && '.join(_nothing(rows)) or 'true'}) {{ {quiet} }} else {{\n{text}\n}}"


def _in_place(loop: _Loop) -> str:
    """A loop that changes fields in place, in rows of its region."""
    lines = []
    names = [out.var.name for out in loop.outs]
    for out in loop.outs:
        assert out.otherwise is not None
        old = str(out.otherwise.attr)
        value = old if old in loop.rows.places else f"keep({old})"
        lines.append(f"{out.var.name} = {value}; bool some{out.var.name} = false;")
    busy = " || ".join(f"!{nothing}" for nothing in _nothing(loop.rows)) or "false"
    lines.append(f"if ({busy}) {{ {' '.join(f'own(c, {name});' for name in names)}")
    lines += [*loop.marking(), _addresses(loop.rows)]
    lines.append(f"EACH_WORLD for (int y = 0; y < rows; y++) {{\n{loop.text()}\n}}")
    lines.append(" ".join(f"{name}->still = no_rows_left(c, {name});" for name in names) + " }")
    return "\n".join(lines)


def _addresses(rows: Rows) -> str:
    """Copies of the addresses that loops need: the compiler cannot prove that stores do not change the originals."""
    values = [value for loop in rows.loops for value in loop.values]
    loads = {str(node.attr): node.type for node in ordered(values) if node.op == "load"}
    types = {rows.places.get(name, name): type for name, type in loads.items()}
    types |= {out.var.name: out.var.type for out in rows.outs}
    forms = {True: "const Field v{0} = *{0}; (void)v{0};", False: "V* const v{0} = {0}->data; (void)v{0};"}
    return " ".join(forms[types[name] == REAL].format(name) for name in types if name not in rows.rings)


def _nothing(rows: Rows) -> list[str]:
    """Tests of fields and planes; if all are true, the loops do nothing."""
    results = {out.var.name for out in rows.outs}
    tests = []
    for region in (loop.region for loop in rows.loops):
        for part in alternatives(region):
            name, test = (part.args[0].attr, "still") if part.op == "live" else (part.attr, "zero")
            tests += [f"{name}->{test}"] if name not in results else []
    return list(dict.fromkeys(tests))


def storage_of(value: Node) -> str:
    """The variable of a plane or field, or the context's constant plane or field."""
    if value.op == "load":
        return str(value.attr)
    if value.type == REAL:
        return "c.calm"
    return "c.everything" if value.attr else "c.nothing"


def on_all(type: str, items: Iterable[str], call: str) -> str:
    """A call on an array of pointers, which the call names `all`."""
    return f"{{ {type} all[] = {braced(items)}; {call} }}"


class _Loop(CellValues[str]):
    """The text of row y of a loop. Values belong to the cells of a chunk: floats, or flags as bits."""

    def __init__(self, number: int, loop: Compute, first_mask: int, rows: Rows, layout: NativeLayout):
        super().__init__(ordered(loop.results))
        self.number, self.loop, self.rows, self.layout = number, loop, rows, layout
        self.outs = loop.outs
        self.chains = chains_of(loop) if loop.over == "choices" else []
        self.masks: list[str] = [choice.args[0].attr for choice in self.chains[0]] if self.chains else []
        """The planes of the masks, in the order in which choices are applied."""
        self.first_mask = first_mask
        """The word of all turned masks at which its masks begin."""
        results = {out.var.name for out in rows.outs}
        self.live, self.planes = region_of(loop)
        # Choices test their masks themselves.
        self.marked = [] if self.chains else [name for name in self.planes if name not in results]
        """The planes whose rows with flags are marked before all loops: there the loop has work."""
        self.passing = [out.var.name for out in self.outs if out.var.name in rows.rings]
        self.lasting = [out for out in self.outs if out.var.type == REAL and out.var.name not in rows.rings]
        self.fields = [out.var.name for out in self.outs if out.var.type == REAL]
        self.flags = [out.var.name for out in self.outs if out.var.type != REAL]
        self.pointers: dict[str, str] = {}
        """Names of pointers to rows, set up once a row, by their values."""
        self.words: dict[str, str] = {}
        """Names of words of planes, read once a row and word, by the plane."""
        layout.cover(marks=number + 1 if self.marked else 0, marked=len(self.marked))

    def before(self) -> Iterator[str]:
        """Statements before the loop: memory for its results, and the marks of its rows."""
        for out in self.lasting:
            field = f"overtaken(c, {out.into})" if out.into else "take_field(c)"
            yield f"{out.var.name} = {field}; bool some{out.var.name} = false; no_rows(c, {out.var.name});"
        yield from (f"{name} = take(c); no_words(c, {name});" for name in self.flags)
        yield from self.marking()

    def marking(self) -> Iterator[str]:
        """Mark the rows in which the region's planes hold a flag, for all lanes at once."""
        if planes := self.marked:
            yield on_all("const Plane* const", planes, f"mark_rows(c, {self.number}, all, {len(planes)});")

    def turns(self) -> str:
        """A call that stores the masks of choices lane by lane."""
        call = f"turn_masks(c, all, {len(self.masks)}, {self.first_mask});"
        return on_all("const Plane* const", self.masks, call)

    def after(self) -> str:
        ends = [f"{out.var.name}->still = !some{out.var.name};" for out in self.lasting]
        return " ".join([*ends, *(f"close_plane(c, {name});" for name in self.flags)])

    def text(self) -> str:
        return "\n".join(self.choice_row() if self.chains else self.cell_row())

    # Rows that are written

    def at(self, name: str, dy: int) -> str:
        """The pointer to a buffered row; to zeros if the row is empty."""
        return f"at{name}[(y + {dy}) & {self.rows.rings[name].depth - 1}]"

    def forget_rings(self) -> str:
        return " ".join(f"{self.at(name, 0)} = nothing;" for name in self.passing)

    def starts(self) -> Iterator[str]:
        """Pointers to the rows that the loop writes."""
        for name in self.flags:
            yield f"Word* o{name} = &lane_word(v{name}, row * words, lane);"
        for name in self.fields:
            if ring := self.rows.rings.get(name):
                row = f"waiting_row(c, {ring.first} + (y & {ring.depth - 1})); {self.at(name, 0)} = o{name}"
            else:
                row = f"row_of(c, v{name}, base + y)"
            yield f"float* o{name} = {row};"

    def ends(self) -> Iterator[str]:
        """The columns beyond the edges of the rows that the loop has written."""
        for name in self.fields:
            if self.is_bare(name):
                bare = self.rows.rings[name].bare
                yield f"bare_row<{bare}>(c.g, o{name});" if bare else ""
            else:
                reach = self.rows.reaches.get(name, 0)
                yield f"finish_row<{'REACH' if reach == ANY_PASS else reach}>(c.g, o{name});"

    def row_outside_region(self) -> Iterator[str]:
        for name, value in self.loop.olds.items():
            if name in self.rows.rings:
                yield f"{self.at(name, 0)} = nothing;"
            elif value.type == REAL and value.op == "const":
                yield f"v{name}.live[base + y] = 0;"
            elif value.op == "const":
                word = f"lane_word(v{name}, row * words + w, lane)"
                rest = "c.valid(w)[lane]" if value.attr else "0"
                yield f"for (int w = 0; w < words; w++) {word} = {rest};"

    # Rows, chunk by chunk

    def cell_row(self) -> Iterator[str]:
        texts = [(out, self.of(out.value)) for out in self.outs]
        stores, counts, lives = [], [], []
        for out, value in texts:
            name = out.var.name
            if out.var.type != REAL:
                stores.append(f"put_bits(o{name} + w * LANES, x, {value});")
                continue
            stores.append(f"*(Fu*)(o{name} + x) = {value};")
            if name not in self.rows.rings:
                counts.append(f"U n{name} = {{}};")
                stores.append(f"n{name} |= (U)blend(inside, {value}, splatf(0));")
                live = f"const bool some = any((V)(n{name} + n{name}));"
                lives.append(f"{{ {live} v{name}.live[base + y] = some; some{name} |= some; }}")
        yield PLACE
        if self.loop.region is not None:
            tests = [self.is_row_live(field) for field in self.live]
            tests += [f"(c.marks[{self.number} * height + row] >> lane & 1)"] if self.marked else []
            rest = [name for name in self.planes if name not in self.marked]
            scans = [f"some |= row_bits(v{name}, row * words, words, lane);" for name in rest]
            busy = " || ".join(tests) or "false"
            yield f"Word some = {busy};" + (f" if (!some) {{ {' '.join(scans)} }}" if scans else "")
            yield f"if (!some) {{ {' '.join(self.row_outside_region())} }} else {{"
        yield " ".join([*self.rows_read(), *self.starts(), *counts])
        yield from (f"if (!WIDTH) o{name}[(words - 1) * LANES] = 0;" for name in self.flags)
        word = "const Word {} = lane_word(v{}, row * words + w, lane);"
        words = [word.format(name, plane) for plane, name in self.words.items()]
        yield f"for (int w = 0; w < words; w++) {{ {' '.join(words)}"
        yield "EACH_CHUNK { const u32 inside = inside_of(x, width); (void)inside;"
        yield from (*self.lines, *stores)
        yield "} }"
        yield " ".join([*self.ends(), *lives, "" if self.loop.region is None else "}"])

    def rows_read(self) -> list[str]:
        return [f"const float* {name} = {call};" for call, name in self.pointers.items()]

    def is_row_live(self, live: Node) -> str:
        name, dy = str(live.args[0].attr), live.attr[0]
        if name in self.rows.rings:
            return f"{self.at(name, dy)} != nothing"
        return f"v{name}.live[base + {f'lines[y + {dy}]' if dy else 'y'}]"

    def choice_row(self) -> Iterator[str]:
        """A row of all choices: the columns of a word stay in registers while its choices are applied."""
        chains, count = self.chains, len(self.masks)
        heads = [f"g{number}[k]" for number in range(len(chains))]
        bases = [str(chain[0].args[2].attr) for chain in chains]
        levels = []
        for level, choices in enumerate(zip(*chains, strict=True)):
            olds = (id(choice.args[2]) for choice in choices)
            with self.inner(dict(zip(olds, heads, strict=True))) as lines:
                values = [self.of(choice.args[1]) for choice in choices]
            lines += map("{0} = blend(bits, {1}, {0});".format, heads, values)
            bits = f"const u32 bits = m >> (x & (BITS - 1)) & ALL; {' '.join(lines)}"
            levels.append(f"{{ const Word m = masks[{level}]; EACH_REGISTER {{ {bits} }} }}")
        with self.inner({id(chain[-1]): head for chain, head in zip(chains, heads, strict=True)}) as ends:
            stores = [f"*(F*)(o{out.var.name} + x) = {self.of(out.value)};" for out in self.outs]
        ends += stores
        olds_at = [self.row(base, 0) for base in bases]
        yield f"const Word* turned = turned_row(c, base + y) + {self.first_mask}; const bool any = any_turned(c, turned, {count});"
        lives = [
            f"{self.at(name, 0)} != nothing" if name in self.rows.rings else f"{name}->live[base + y]"
            for name in dict.fromkeys(bases)
        ]
        yield " ".join(self.rows_read())
        chosen = [node for chain in chains for node in ordered(choice.args[1] for choice in chain)]
        # If all choices are values of fields at other cells, they are zero where these fields are.
        moves = all(node.op in ("shift", "load") or is_zero(node) for node in chosen)
        near = " || ".join(f"{name} != nothing" for name in self.pointers.values()) if moves else "true"
        yield f"const bool some = any ? {near} : {' || '.join(lives)};"
        names = [out.var.name for out in self.lasting]
        yield " ".join(map("some{0} |= v{0}.live[base + y] = some;".format, names))
        yield f"if (!some) {{ {self.forget_rings()} }} else {{"
        yield " ".join(self.starts())
        yield f"for (int w = 0; w < words; w++) {{ const Word* masks = turned + w * TURNED; const u64 which = which_turned(masks, {count});"
        yield " ".join(f"F g{number}[BITS / CHUNK];" for number in range(len(chains)))
        loads = (f"{head} = load({old}, x);" for head, old in zip(heads, olds_at, strict=True))
        yield f"EACH_REGISTER {{ {' '.join(loads)} }}"
        for begin in range(0, count, AT_ONCE):
            bits = f"which & {(1 << AT_ONCE) - 1 << begin % 64:#x}ull" if count <= 64 else "which"
            yield f"if ({bits}) {{ {' '.join(levels[begin : begin + AT_ONCE])} }}"
        yield f"EACH_REGISTER {{ {' '.join(ends)} }} }}"
        yield f"{' '.join(self.ends())} }}"

    # Values

    def temporary(self, text: str, type: str = "F", prefix: str = "v") -> str:
        name = self.fresh(prefix)
        self.lines.append(f"const {type} {name} = {text};")
        return name

    def is_bare(self, name: str) -> bool:
        """True if a field's rows have zeros beyond the edges."""
        return name in self.rows.rings and self.rows.rings[name].bare is not None

    def row(self, field: str, dy: int, *, wraps: bool = True) -> str:
        field = self.rows.places.get(field, field)
        if field in self.rows.rings:
            call = self.at(field, dy)
        elif wraps and dy > 0 and field in self.rows.saved:
            call = f"(y + {dy} < rows ? real_line(c, v{field}, base + y + {dy}, nothing) : first{field}[y + {dy} - rows])"
        elif wraps or not dy:
            call = f"real_line(c, v{field}, base + {f'lines[y + {dy}]' if dy else 'y'}, nothing)"
        else:
            call = f"real_line_or_nothing(c, v{field}, base, y + {dy}, rows, nothing)"
        return self.pointers.setdefault(call, f"r{len(self.pointers)}")

    def mask(self, node: Node) -> str:
        """The bits of a chunk in a flag's plane."""
        if node.op == "param":
            word = f"words_of(c.param_bits[{self.layout.param_planes[param_key(node)]}])[l]"
        else:
            word = self.words.setdefault(str(node.attr), f"m{len(self.words)}")
        return f"(u32)({word} >> (x & (BITS - 1)) & ALL)"

    def node(self, node: Node, args: Sequence[str]) -> str:
        attr = node.attr
        match node.op:
            case "const":
                return f"splatf({literal(float(attr))})"
            case "load" if node.type != REAL:
                return self.temporary(self.mask(node), "u32", "b")
            case "load":
                return self.temporary(f"load({self.row(str(attr), 0)}, x + 0)")
            case "param":
                return self.temporary(f"splatf(c.param_real[{self.layout.param_reals[attr[0]]}][l])")
            case "draw":
                return self.draw(node)
            case "select":
                return self.choice(node)
            case "led":
                return self.led(node)
            case "shift":
                dy, dx, wraps = attr
                field = str(node.args[0].attr)
                loaded = f"load({self.row(field, dy, wraps=wraps)}, x + {dx})"
                within = wraps or not dx or self.is_bare(field)
                self.layout.cover(reach=abs(dx) if within else 0)
                return self.temporary(loaded if within else f"inside_columns({loaded}, x, {dx}, width)")
        if node.op == "div" and node.args[1].op == "const" and node.args[1].attr:
            return self.temporary(quotient(args[0], float(node.args[1].attr)))
        text = _FLOATS[node.op].format(*args, *map(literal, attr or ()))
        return self.temporary(text, "u32", "b") if node.type == FLAG else self.temporary(text)

    def draw(self, node: Node) -> str:
        stream, bits = node.attr
        name = self.fresh("d")
        cell = f"draw_cell(c, {self.layout.streams[stream]}, lane, row, std::min(x + i, width - 1), {bits})"
        self.lines.append(f"F {name}; for (int i = 0; i < CHUNK; i++) {name}[i] = {cell};")
        return name

    def led(self, node: Node) -> str:
        """A comparison, computed only where its leader holds somewhere in the chunk, together with others it leads."""
        first, led = self.of(node.args[0]), self.led_by(node.args[0])
        names: dict[object, str] = {id(comparison): self.fresh("b") for comparison in led}
        with self.inner() as lines:
            values = [self.of(comparison.args[1]) for comparison in led]
        for name, value in zip(names.values(), values, strict=True):
            self.lines.append(f"u32 {name} = 0;")
            lines.append(f"{name} = {value} & {first};")
        self.lines.append(f"if ({first}) {{ {' '.join(lines)} }}")
        self.known |= names
        return names[id(node)]

    def variable(self, value: str) -> str:
        name = self.fresh("v")
        self.lines.append(f"F {name} = {value};")
        return name

    def chosen(self, mask: Node, variables: Sequence[str], values: Sequence[Node]) -> None:
        bits = self.fresh("b")
        with self.inner() as lines:
            texts = [self.of(value) for value in values]
        lines += map(f"{{0}} = blend({bits}, {{1}}, {{0}});".format, variables, texts)
        self.lines.append(f"if (const u32 {bits} = {self.mask(mask)}) {{ {' '.join(lines)} }}")


def quotient(value: str, divisor: float) -> str:
    """A division by a constant; a product, unless the divisor's fraction is all ones (Markstein 1990, theorem 8)."""
    if all_ones(divisor) or not 2.0**-60 < abs(divisor) < 2.0**60:
        return f"{value} / splatf({literal(divisor)})"
    return f"divide_by({value}, {literal(divisor)}, {literal(single(1.0 / single(divisor)))})"
