"""Schedules -> C++: loops over rows and words of planes, movements, guards. All decisions are the schedule's."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from powderdsl.ir.ops import REAL, Node
from powderdsl.schedule.costs import DRAWS, is_coin
from powderdsl.schedule.rows import reaches_of
from powderdsl.schedule.types import (
    Compute,
    Forget,
    Guard,
    Move,
    Out,
    Release,
    Schedule,
    Sweeps,
    Var,
    alternatives,
    variables,
)
from powderdsl.schedule.words import difference, only_clears
from powderdsl.targets.cpp.cells import on_all, storage_of, sweeps_text
from powderdsl.targets.layout import NativeLayout, fixed_key, number, param_key
from powderdsl.targets.printing import GATES, Printer, WordText, drawn_where, limited_draw

LOOP = (
    "for (int y = 0, i = 0; y < height; y++) for (int w = 0; w < words; w++, i++) "
    "{ const V valid = c.valid(w); (void)valid;"
)


def pass_text(schedule: Schedule, number: int, layout: NativeLayout) -> str:
    printer = _Printer(layout, schedule)
    changed = dict(schedule.outputs)
    lines = [f"// pass {number}\n__attribute__((noinline)) void pass_{number}(Context& c) {{"]
    if schedule.when is not None:
        lines.append(f"if (!{answer(schedule.when)}) return;")
    lines.append(
        "const int words = c.g.words, height = c.g.height, width = c.g.width, strips = c.g.strips, "
        "*rows = c.rows(); (void)words; (void)height; (void)width; (void)strips; (void)rows;"
    )
    rest = variables(schedule)
    for slot, var in schedule.inputs:
        del rest[var.name]
        place = printer.slot(slot, var)
        if slot in changed:  # without a second reference, so that it may be overwritten
            lines.append(f"{KINDS[var.type.name]}* {var.name} = {place};")
        else:
            lines.append(f"{KINDS[var.type.name]}* {var.name} = keep({place});")
    for var in rest.values():
        lines.append(f"{KINDS[var.type.name]}* {var.name};")
    lines += printer.block(schedule.body)
    inputs, stored = dict(schedule.inputs), set()
    for slot, node in schedule.outputs:
        var = Var(storage_of(node), node.type)
        place, moves = printer.slot(slot, var), node.op == "load" and var.name not in stored
        stored.add(var.name)
        if slot not in inputs:
            lines.append(f"give(c, {place});")
        lines.append(f"{place} = {var.name if moves else f'keep({var.name})'};")
    return "\n".join([*lines, "}"])


KINDS = {"real": "Field", "flag": "Plane"}
"""The type of a variable's memory."""


def answer(node: Node) -> str:
    match node.op:
        case "any" | "some":
            return " || ".join(map("!{0.attr}->zero".format, node.args)) or "false"
        case "present":
            return f"(c.present & {node.attr:#x}ull)"
        case "const":
            return "true" if node.attr else "false"
    sign = " && " if node.op == "and" else " || "
    return f"({sign.join(map(answer, node.args))})"


class _Printer(Printer):
    def __init__(self, layout: NativeLayout, schedule: Schedule):
        self.layout, self.graph, self.reaches = layout, schedule.graph, reaches_of(schedule)

    def slot(self, name: str, var: Var) -> str:
        if var.type == REAL:
            return f"c.real[{self.layout.reals[name]}]"
        return f"c.slot[{self.layout.planes[name]}]"

    def whole(self, out: Out) -> Iterator[str]:
        """An operation on whole planes that tests for empty planes itself."""
        value, args = out.value, out.value.args
        match value.op:
            case "load" | "const":
                call = f"keep({storage_of(value)})"
            case "shift":
                dy, dx, _ = value.attr
                self.layout.cover(around_rows=abs(dy))
                call = f"shifted(c, {args[0].attr}, {dy}, {dx})"
            case "or":
                call = f"joined(c, {args[0].attr}, {args[1].attr})"
            case _:
                stays, gone = difference(value)
                call = f"cleared(c, {stays.attr}, {gone.attr})"
        yield f"{out.var.name} = {call};"

    def sweeps(self, sweeps: Sweeps) -> Iterator[str]:
        yield sweeps_text(sweeps, self.layout, self.reaches)

    def release(self, release: Release) -> Iterator[str]:
        yield " ".join(map("give(c, {});".format, release.frees))

    def forget(self, _: Forget) -> Iterator[str]:
        yield "c.present = ~0ull;"

    def guard(self, guard: Guard) -> Iterator[str]:
        yield f"if ({answer(guard.when)}) {{"
        yield from self.block(guard.body)
        if guard.outs:
            yield "} else {"
            for out in guard.outs:
                yield f"{out.var.name} = keep({storage_of(out.value)});"
        yield "}"

    def move(self, move: Move) -> Iterator[str]:
        """Planes that move, or fields that exchange values; as few as possible are copied."""
        dy, dx = move.offset
        self.layout.cover(around_rows=abs(dy))
        movers, fields = str(move.region.attr), move.outs[0].var.type == REAL
        groups = move.leftovers()
        # `arrive_planes` moves by one row.
        copies = not fields and (groups is None or (move.op == "arrive" and abs(dy) > 1))
        if copies and move.op == "swap":
            target = f"shifted(c, {movers}, {-dy}, {-dx})"
            for out in move.outs:
                name, rest = out.var.name, storage_of(out.value)
                call = f"swap_plane(c, {move.olds[name].attr}, {movers}, target, {rest}, {dy}, {dx})"
                yield f"{{ Plane* target = {target}; {name} = {call}; give(c, target); }}"
                if out.into:
                    yield f"give(c, {out.into});"
            return
        news = [*map("&{}".format, move.vars)]
        for out in move.outs:
            old = storage_of(out.value) if copies else move.olds[out.var.name].attr
            yield f"{out.var.name} = {out.into or f'keep({old})'};"
        if fields:
            yield on_all("Field** const", news, f"swap_fields<{len(news)}>(c, {movers}, {dy}, {dx}, all);")
            return
        self.layout.cover(moving=len(news))
        if copies:
            olds = ", ".join(str(old.attr) for old in move.olds.values())
            call = f"arrive_over(c, {movers}, {dy}, {dx}, olds, news, {len(news)});"
            yield f"{{ Plane* const olds[] = {{{olds}}}; Plane** const news[] = {{{', '.join(news)}}}; {call} }}"
        for leaves, planes in groups.items() if groups and not copies else ():
            function, more = (
                ("swap_planes", "") if move.op == "swap" else ("arrive_planes", f", {leaves.upper()}")
            )
            call = f"{function}(c, {movers}, {dy}, {dx}, all, {len(planes)}{more});"
            yield on_all("Plane** const", map("&{0.var.name}".format, planes), call)

    def update(self, loop: Compute) -> Iterator[str]:
        """Planes that change only in words where a mask holds. Empty planes that can only lose flags need no copy."""
        values = _Words(self.layout)
        for out in loop.outs:
            assert out.otherwise is not None
            name, old = out.var.name, str(out.otherwise.attr)
            if out.into:
                values.places[old] = name
            yield f"{name} = {old if out.into else f'keep({old})'};"
        masks = alternatives(loop.region)
        yield f"if ({' || '.join(map('!{0.attr}->zero'.format, masks))}) {{"
        before, stores, after = [], [], []
        for out in loop.outs:
            assert out.otherwise is not None
            name, value = out.var.name, values.clean(out.value)
            words = values.plane(name)
            if only_clears(out, self.graph):
                before.append(f"if (!{name}->zero) own(c, {name});")
                stores.append(f"{words}[i] = {value};")
            else:  # a plane that was empty may stay empty
                before.append(f"V a{name} = splat(0); const bool e{name} = {name}->zero; own(c, {name});")
                stores.append(f"{{ const V o = {value}; {words}[i] = o; a{name} |= o; }}")
                after.append(f"{name}->zero = e{name} && !any(a{name});")
        skip = f"if (!any({' | '.join(map(values.node, masks))})) continue;"
        yield "\n".join([*before, values.ready(), " ".join(values.pointers), LOOP, skip])
        yield "\n".join([*values.lines, *stores, "}", *after, "}"])

    def words(self, loop: Compute) -> Iterator[str]:
        """New planes."""
        values = _Words(self.layout)
        without, before, stores, after = [], [], [], []
        for out in loop.outs:
            name = out.var.name
            without.append(f"{name} = keep(c.nothing);")
            before.append(f"{name} = take(c); V* const d{name} = {name}->data; V a{name} = splat(0);")
            stores.append(f"{{ const V o = {values.clean(out.value)}; d{name}[i] = o; a{name} |= o; }}")
            after.append(f"{name}->zero = !any(a{name});")
        skipped = "" if loop.when is None else f"if (!{answer(loop.when)}) {{ {' '.join(without)} }} else "
        yield f"{skipped}{{"
        yield values.ready()
        yield " ".join(before)
        yield "\n".join([" ".join(values.pointers), LOOP, *values.lines, *stores, "}"])
        yield " ".join(after) + " }"


CLEAN = ("load", "const", "inside", "when", "shift", *DRAWS)
"""Operations that give no flags beyond the width."""


class _Words(WordText):
    """Values of a word of columns in as many worlds as a vector holds."""

    type = "V"

    def __init__(self, layout: NativeLayout):
        super().__init__()
        self.layout = layout
        self.edges: dict[str, int] = {}
        """The largest distance in rows at which a plane is read, by the call that prepares such rows."""
        self.places: dict[str, str] = {}
        """The planes that hold the old values of planes which are changed in place."""
        self.read: dict[str, str] = {}
        """Cached data pointers: the compiler cannot prove that stores do not change the originals."""
        self.pointers: list[str] = []
        """Statements before the loop that set these pointers."""

    def ready(self) -> str:
        """Statements before the loop that prepare the rows of other strips."""
        return " ".join(map("{}, {});".format, self.edges, self.edges.values()))

    def plane(self, name: str) -> str:
        return self.pointer(f"{self.places.get(name, name)}->data")

    def pointer(self, words: str) -> str:
        if words not in self.read:
            self.read[words] = f"r{len(self.read)}"
            self.pointers.append(f"V* const {self.read[words]} = {words};")
        return self.read[words]

    def lazy(self, node: Node) -> str:
        """A conjunction whose second part is computed only where the first holds somewhere in the word."""
        name, first = self.fresh("g"), self.known[id(node.args[0])]
        with self.inner() as lines:
            value = self.clean(node.args[1])
        inner = " ".join(lines)
        self.lines.append(f"V {name} = splat(0);\nif (any({first})) {{ {inner} {name} = {value}; }}")
        return name

    def clean(self, node: Node) -> str:
        """The value with zeros beyond the grid's width."""
        name = self.of(node)
        return name if node.op in CLEAN else self.named(node, f"{name} & valid")

    def node(self, node: Node, args: Sequence[str] = ()) -> str:
        if (draw := limited_draw(node)) is not None:
            return self.known[id(draw)]
        attr = node.attr
        if node.op in GATES:
            return GATES[node.op].format(*args)
        match node.op:
            case "load":
                return f"{self.plane(str(attr))}[i]"
            case "shift":
                return self.shift(node)
            case "when":
                return self.lazy(node)
            case "const":
                return "valid" if attr else "splat(0)"
            case "param":
                return f"words_of(c.param_bits[{self.layout.param_planes[param_key(node)]}])"
            case "coordinate" if attr[0] == "step":
                return f"c.step_bits[{self.layout.step_planes[attr[1:]]}]"
            case "coordinate" | "inside":
                return f"{self.pointer(f'c.fixed[{self.layout.fixed[fixed_key(node)]}]')}[i]"
            case "chance" | "below_planes" | "below_param":
                return self.draw(node, args)
        raise AssertionError(f"no C++ kernel for {node.op}")

    def draw(self, node: Node, args: Sequence[str]) -> str:
        """A draw below a limit: a number, or planes from the highest."""
        stream, bits = self.layout.streams[node.attr[0]], node.attr[1]
        where = drawn_where(node)
        wanted = "valid" if where is None else self.clean(where)
        # A coin is tossed once a step for all masks, so its plane is shared.
        if is_coin(node):
            coin = number(self.layout.coins, stream)
            return f"{wanted} & ~{self.pointer(f'coin_plane(c, {coin}, {stream})')}[i]"
        if node.op == "chance":
            return f"draw_below(c, {stream}, y, w, {wanted}, {bits}, {node.attr[2]}ull)"
        if node.op == "below_param":
            kind, limit = "flags", f"c.param_bits + {self.layout.limit(node)}"
        else:
            kind, limit = "planes", self.fresh("limit")
            self.lines.append(f"const V {limit}[] = {{{', '.join(args[: bits + 1])}}};")
        return f"draw_below_{kind}(c, {stream}, y, w, {wanted}, {bits}, {limit})"

    def shift(self, node: Node) -> str:
        dy, dx, wraps = node.attr
        plane = str(node.args[0].attr)
        if dy:
            call = f"{'edges' if wraps else 'bare_edges'}(c, {plane}"
            self.edges[call] = max(self.edges.get(call, 0), abs(dy))
        if not wraps:
            row = f"row_or_nothing(c, {plane}, y + {dy})"
            return f"columns_zero(c, {row}, w, {dx})" if dx else f"{row}[w]"
        self.layout.cover(around_rows=abs(dy))
        row, words = f"rows[y + {dy}]" if dy else "y * words", self.plane(plane)
        return f"columns(c, {words} + {row}, w, {dx})" if dx else f"{words}[{row} + w]"
