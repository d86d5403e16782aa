"""Schedules -> C++: loops over rows and words of planes, movements, guards. Nothing is decided here."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from powderdsl.ir.ops import FLAG, REAL, Node
from powderdsl.schedule.costs import is_coin
from powderdsl.schedule.types import Compute, Guard, Move, Out, Schedule, Statement, Sweeps, Var, variables
from powderdsl.schedule.words import asked, is_cleared
from powderdsl.targets.cpp.cells import reaches_of, sweeps_text
from powderdsl.targets.layout import Layout, number, param_key
from powderdsl.targets.statements import printed
from powderdsl.targets.values import WordValues

_LOGIC = {"and": "&", "or": "|", "xor": "^"}
LOOP = (
    "for (int y = 0, i = 0; y < height; y++) for (int w = 0; w < words; w++, i++) "
    "{ const V valid = c.valid(w); (void)valid;"
)


def pass_text(schedule: Schedule, number: int, layout: Layout) -> str:
    """The function of a pass."""
    printer = _Printer(layout, schedule)
    changed = {slot for slot, _ in schedule.leaves}
    lines = []
    if schedule.when is not None:
        lines.append(f"if (!{answer(schedule.when)}) return;")
    lines.append(
        "const int words = c.g.words, height = c.g.height, width = c.g.width, strips = c.g.strips ? -1 : 0, "
        "*rows = c.rows(); (void)words; (void)height; (void)width; (void)strips; (void)rows;"
    )
    for slot, var in schedule.finds:
        place = printer.slot(slot, var)
        if slot in changed:  # nothing else refers to it while the pass runs, so it may be overwritten
            lines.append(f"{kind(var)}* {var.name} = {place}; {place} = nullptr;")
        else:
            lines.append(f"{kind(var)}* {var.name} = keep({place});")
    there = {var.name for _, var in schedule.finds}
    lines += [f"{kind(var)}* {name};" for name, var in variables(schedule).items() if name not in there]
    lines += printer.block(schedule.body)
    lines += printer.leave(schedule)
    body = "\n".join(lines)
    return f"// pass {number}\n__attribute__((noinline)) void pass_{number}(Context& c) {{\n{body}\n}}"


def kind(var: Var) -> str:
    return "Field" if var.type == REAL else "Plane"


def answer(node: Node) -> str:
    """A condition in C++."""
    match node.op:
        case "any":
            return f"!{node.args[0].attr}->zero"
        case "present":
            return f"(c.present & {node.attr:#x}ull)"
        case "const":
            return "true" if node.attr else "false"
    sign = " && " if node.op == "and" else " || "
    return f"({sign.join(map(answer, node.args))})"


class _Printer:
    def __init__(self, layout: Layout, schedule: Schedule):
        self.layout, self.graph, self.reaches = layout, schedule.graph, reaches_of(schedule)

    def slot(self, name: str, var: Var) -> str:
        if var.type == REAL:
            return f"c.real[{self.layout.reals[name]}]"
        return f"c.slot[{self.layout.planes[name]}]"

    def block(self, body: Sequence[Statement]) -> Iterator[str]:
        for statement in body:
            yield from printed(self, statement)

    def whole(self, out: Out) -> Iterator[str]:
        """An operation on whole planes that tests for empty ones itself."""
        yield f"{out.var.name} = {self.of_planes(out.value)};"

    def of_planes(self, value: Node) -> str:
        args = value.args
        match value.op:
            case "load" | "const":
                return f"keep({_held(value)})"
            case "shift":
                dy, dx, _ = value.attr
                self.layout.around = max(self.layout.around, abs(dy))
                return f"shifted(c, {args[0].attr}, {dy}, {dx})"
            case "or":
                return f"joined(c, {args[0].attr}, {args[1].attr})"
        kept, gone = args if args[1].op == "not" else args[::-1]
        return f"cleared(c, {kept.attr}, {gone.args[0].attr})"

    def sweeps(self, sweeps: Sweeps) -> Iterator[str]:
        yield sweeps_text(sweeps, self.layout, self.reaches)

    def release(self, names: Iterable[str]) -> Iterator[str]:
        yield " ".join(f"give(c, {name});" for name in names)

    def forget(self) -> Iterator[str]:
        yield "c.present = ~0ull;"

    def leave(self, schedule: Schedule) -> Iterator[str]:
        """The new values of slots; all are read before any is stored."""
        left = []
        for i, (slot, node) in enumerate(schedule.leaves):
            value = node.attr if node.op == "load" else "c.everything" if node.attr else "c.nothing"
            yield f"{'Field' if node.type == REAL else 'Plane'}* s{i} = keep({value});"
            left.append(self.slot(slot, Var(value, node.type)))
        for i, place in enumerate(left):
            yield f"if ({place}) give(c, {place}); {place} = s{i};"
        names = dict.fromkeys(str(node.attr) for _, node in schedule.leaves if node.op == "load")
        yield " ".join(f"give(c, {name});" for name in names)

    def guard(self, guard: Guard) -> Iterator[str]:
        asked = " || ".join(f"!{node.attr}->zero" for node in guard.when) or "false"
        yield f"if ({asked}) {{"
        yield from self.block(guard.body)
        if guard.keeps:
            yield "} else {"
            for var, value in guard.keeps:
                yield f"{var.name} = {_kept(value)};"
        yield "}"

    def move(self, move: Move) -> Iterator[str]:
        dy, dx = move.offset
        self.layout.around = max(self.layout.around, abs(dy))
        movers = str(move.movers.attr)
        if move.planes[0].new.type == REAL:
            yield from self.exchange(move)
            return
        far = move.op == "arrive" and abs(dy) > 1  # `arrive_planes` moves by one row
        copies = far or any(plane.leftover(move.movers) is None for plane in move.planes)
        if copies and move.op == "swap":
            target = f"shifted(c, {movers}, {-dy}, {-dx})"
            for plane in move.planes:
                old, rest = plane.old.attr, _held(plane.leaves)
                call = f"swap_plane(c, {old}, {movers}, target, {rest}, {dy}, {dx})"
                yield f"{{ Plane* target = {target}; {plane.new.name} = {call}; give(c, target); }}"
                if plane.into:
                    yield f"give(c, {plane.into});"
            return
        self.layout.moving = max(self.layout.moving, len(move.planes))
        kinds: dict[str, list[str]] = {}
        for plane in move.planes:
            kept = f"keep({_held(plane.leaves) if copies else plane.old.attr})"
            yield f"{plane.new.name} = {plane.into or kept};"
            if copies:
                continue
            kinds.setdefault(str(plane.leftover(move.movers)), []).append(f"&{plane.new.name}")
        if copies:
            olds = ", ".join(str(plane.old.attr) for plane in move.planes)
            news = ", ".join(f"&{plane.new.name}" for plane in move.planes)
            call = f"arrive_over(c, {movers}, {dy}, {dx}, olds, news, {len(move.planes)});"
            yield f"{{ Plane* const olds[] = {{{olds}}}; Plane** const news[] = {{{news}}}; {call} }}"
        for leaves, targets in kinds.items():
            function = "swap_planes" if move.op == "swap" else f"arrive_planes<{leaves.upper()}>"
            call = f"{function}(c, {movers}, {dy}, {dx}, all, {len(targets)});"
            yield f"{{ Plane** const all[] = {{{', '.join(targets)}}}; {call} }}"

    def exchange(self, move: Move) -> Iterator[str]:
        """Fields that exchange values."""
        dy, dx = move.offset
        for field in move.planes:
            value = field.into or f"keep({field.old.attr})"
            yield f"{field.new.name} = {value};"
        fields = ", ".join(f"&{field.new.name}" for field in move.planes)
        call = f"swap_fields<{len(move.planes)}>(c, {move.movers.attr}, {dy}, {dx}, all);"
        yield f"{{ Field** const all[] = {{{fields}}}; {call} }}"

    def update(self, loop: Compute) -> Iterator[str]:
        """Planes that change only in words where a mask holds. Empty ones that can only lose flags need no copy."""
        values = _Words(self.layout)
        for out in loop.outs:
            assert out.otherwise is not None
            name, old = out.var.name, str(out.otherwise.attr)
            if out.into:
                values.places[old] = name
            yield f"{name} = {old if out.into else f'keep({old})'};"
        masks = [str(node.attr) for node in asked(loop)]
        yield f"if ({' || '.join(f'!{mask}->zero' for mask in masks)}) {{"
        before, stores, after = [], [], []
        for out in loop.outs:
            assert out.otherwise is not None
            name, value = out.var.name, values.clean(out.value)
            words = values.plane(name)
            if is_cleared(out, self.graph):
                before.append(f"if (!{name}->zero) own(c, {name});")
                stores.append(f"{words}[i] = {value};")
            else:  # one that was empty may stay so
                before.append(f"V a{name} = splat(0); const bool e{name} = {name}->zero; own(c, {name});")
                stores.append(f"{{ const V o = {value}; {words}[i] = o; a{name} |= o; }}")
                after.append(f"{name}->zero = e{name} && !any(a{name});")
        some = " | ".join(f"{values.plane(mask)}[i]" for mask in masks)
        yield "\n".join([*before, values.ready(), values.pointers(), LOOP, f"if (!any({some})) continue;"])
        yield "\n".join([*values.lines, *stores, "}", *after, "}"])

    def words(self, loop: Compute) -> Iterator[str]:
        names = [out.var.name for out in loop.outs]
        values = _Words(self.layout)
        stores = [
            f"{{ const V o = {values.clean(out.value)}; d{out.var.name}[i] = o; a{out.var.name} |= o; }}"
            for out in loop.outs
        ]
        if loop.when is not None:
            without = " ".join(f"{name} = keep(c.nothing);" for name in names)
            yield f"if (!{answer(loop.when)}) {{ {without} }} else {{"
        else:
            yield "{"
        yield values.ready()
        yield " ".join(
            f"{name} = take(c); V* const d{name} = {name}->data; V a{name} = splat(0);" for name in names
        )
        yield "\n".join([values.pointers(), LOOP, *values.lines, *stores, "}"])
        yield " ".join(f"{name}->zero = !any(a{name});" for name in names) + " }"


def _held(value: Node) -> str:
    """The variable that holds a plane, or a constant plane of the context."""
    return str(value.attr) if value.op == "load" else "c.everything" if value.attr else "c.nothing"


def _kept(value: Node) -> str:
    if value.op == "load" or value.type == FLAG:
        return f"keep({_held(value)})"
    return "keep(c.calm)"


class _Words(WordValues):
    """Values of a word of columns in as many worlds as a vector holds."""

    type, leaf = "V", "shift"

    def __init__(self, layout: Layout):
        super().__init__()
        self.layout = layout
        self.edges: dict[tuple[str, str], int] = {}
        """The largest distance in rows at which a plane is read, by the function that prepares such rows and the plane."""
        self.clear: dict[int, bool] = {}
        self.places: dict[str, str] = {}
        """The planes that hold the old values of planes which are changed in place."""
        self.read: dict[str, str] = {}
        """The pointers to planes that the loop reads, which would be loaded again after every store, by what they point to."""

    def ready(self) -> str:
        """Statements before the loop that prepare the rows of other strips."""
        return " ".join(f"{call}(c, {plane}, {rows});" for (call, plane), rows in self.edges.items())

    def plane(self, name: str) -> str:
        """The pointer to a plane's words."""
        return self.pointer(f"{self.places.get(name, name)}->data")

    def pointer(self, words: str) -> str:
        if words not in self.read:
            self.read[words] = f"r{len(self.read)}"
        return self.read[words]

    def pointers(self) -> str:
        """Statements before the loop that name what it points to."""
        return " ".join(f"V* const {name} = {words};" for words, name in self.read.items())

    def lazy(self, node: Node) -> str:
        """A conjunction whose second part is computed only where the first holds somewhere in the word."""
        self.count += 1
        name = f"g{self.count}"
        first = self.known[id(node.args[0])]
        outer, self.lines = self.lines, []
        known = dict(self.known)
        value = self.clean(node.args[1])
        inner, self.lines = self.lines, outer
        self.known = known
        self.lines.append(
            f"V {name} = splat(0);\nif (any({first})) {{ {' '.join(inner)} {name} = {value}; }}"
        )
        return name

    def clean(self, node: Node) -> str:
        """The value with zeros beyond the grid's width."""
        name = self.of(node)
        return name if self.is_clean(node) else self.name(f"{name} & valid")

    def is_clean(self, node: Node) -> bool:
        """Whether bits beyond the width are known to be zero."""
        if id(node) not in self.clear:
            match node.op:
                case (
                    "load" | "const" | "inside" | "chance" | "below_planes" | "below_param" | "when" | "shift"
                ):
                    found = True
                case "coordinate":
                    found = node.attr[0] != "step"
                case "and":
                    found = any(self.is_clean(arg) for arg in node.args)
                case "or" | "xor":
                    found = all(self.is_clean(arg) for arg in node.args)
                case "select":
                    found = all(self.is_clean(arg) for arg in node.args[1:])
                case _:
                    found = False
            self.clear[id(node)] = found
        return self.clear[id(node)]

    def row(self, plane: str, dy: int) -> str:
        if dy == 0:
            return "y * words"
        self.reads("edges", plane, dy)
        self.layout.around = max(self.layout.around, abs(dy))
        return f"rows[y + {dy}]"

    def reads(self, call: str, plane: str, dy: int) -> None:
        if dy:
            self.edges[call, plane] = max(self.edges.get((call, plane), 0), abs(dy))

    def node(self, node: Node) -> str:
        attr = node.attr
        if node.op == "and":
            for value, draw in (node.args, node.args[::-1]):
                if draw.op in ("chance", "below_param", "below_planes") and draw.args[-1:] == (value,):
                    return self.known[id(draw)]  # it holds only where it is drawn
        args = [self.known[id(arg)] for arg in node.args] if node.op != "shift" else []
        if node.op in _LOGIC:
            return f"{args[0]} {_LOGIC[node.op]} {args[1]}"
        match node.op:
            case "load":
                return f"{self.plane(str(attr))}[i]"
            case "shift":
                return self.shift(node)
            case "const":
                return self.name("valid" if attr else "splat(0)")
            case "param":
                return f"c.param_bits[{self.layout.param_planes[param_key(node)]}]"
            case "coordinate":
                axis, modulus, bit = attr
                if axis == "step":
                    return f"c.step_bits[{self.layout.step_planes[modulus, bit]}]"
                fixed = self.layout.fixed[0 if axis == "row" else 1, modulus, bit]
                return f"{self.pointer(f'c.fixed[{fixed}]')}[i]"
            case "inside":
                return f"{self.pointer(f'c.fixed[{self.layout.fixed[2, attr[0], attr[1]]}]')}[i]"
            case "chance":
                stream, bits, limit = attr
                wanted = self.clean(node.args[0]) if args else "valid"
                if is_coin(node):
                    coin = number(self.layout.coins, self.layout.streams[stream])
                    plane = self.pointer(f"coin_plane(c, {coin}, {self.layout.streams[stream]})")
                    return f"{wanted} & ~{plane}[i]"
                return f"draw_below(c, {self.layout.streams[stream]}, y, w, {wanted}, {bits}, {limit}ull)"
            case "below_planes":
                bits = attr[1]
                return self.below(node, args[: bits + 1], node.args[bits + 1 :])
            case "below_param":
                _, bits, name, view = attr
                numbers = [self.layout.param_planes[name, view, i] for i in range(bits, -1, -1)]
                limit = [f"c.param_bits[{number}]" for number in numbers]
                return self.below(node, limit, node.args, numbers)
            case "not":
                return f"~{args[0]}"
            case "select":
                return f"mux({', '.join(args)})"
        raise AssertionError(f"no C++ kernel for {node.op}")

    def below(
        self, node: Node, limit: Sequence[str], where: Sequence[Node], numbers: Sequence[int] = ()
    ) -> str:
        """A draw below a limit, given plane by plane from the highest. `numbers`: where they lie among parameters."""
        stream, bits = node.attr[:2]
        wanted = self.clean(where[0]) if where else "valid"
        first = numbers[0] if numbers else -1
        if numbers and list(numbers) == list(range(first, first + bits + 1)):
            return f"draw_below_planes(c, {self.layout.streams[stream]}, y, w, {wanted}, {bits}, c.param_bits + {first})"
        self.count += 1
        name = f"limit{self.count}"
        self.lines.append(f"const V {name}[] = {{{', '.join(limit)}}};")
        return f"draw_below_planes(c, {self.layout.streams[stream]}, y, w, {wanted}, {bits}, {name})"

    def shift(self, node: Node) -> str:
        dy, dx, wraps = node.attr
        plane = str(node.args[0].attr)
        if wraps:
            if not dx:
                return f"{self.plane(plane)}[{self.row(plane, dy)} + w]"
            return f"columns(c, {self.plane(plane)} + {self.row(plane, dy)}, w, {dx})"
        self.reads("bare_edges", plane, dy)
        row = f"row_or_nothing(c, {plane}, y + {dy})"
        return f"columns_zero(c, {row}, w, {dx})" if dx else f"{row}[w]"
