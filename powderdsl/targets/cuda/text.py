"""Schedules -> CUDA C++: loops over words and cells, with buffers for variables. All decisions are the schedule's."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from powderdsl.ir.ops import FLAG, REAL, Node, ordered
from powderdsl.ir.text import infix
from powderdsl.schedule.types import ANSWER, Compute, Guard, Schedule, Sync
from powderdsl.targets.layout import Layout, literal, param_key
from powderdsl.targets.printing import FLOATS, GATES, CellValues, Printer, WordText, drawn_where

_FLOATS = {
    **FLOATS,
    **infix("eq lt le"),
    "abs": "MAGNITUDE({0})",
    "sqrt": "ROOT({0})",
    "clamp": "clamped({0}, {1}, {2})",
}
"""The expression of each operation on floats. Arguments are numbered first, then the attribute's numbers."""


def pass_text(schedule: Schedule, layout: Layout) -> str:
    numbers = {name: number for name, (_, number) in schedule.buffers}
    return "\n".join(_Printer(numbers, layout).block(schedule.body))


class _Printer(Printer):
    def __init__(self, numbers: dict[str, int], layout: Layout):
        self.numbers, self.layout = numbers, layout
        """The numbers of buffers by variable."""

    def sync(self, _: Sync) -> Iterator[str]:
        yield "SYNC();"

    def compute(self, loop: Compute) -> Iterator[str]:
        return self.words(loop) if loop.over == "words" else self.cells(loop)

    def guard(self, guard: Guard) -> Iterator[str]:
        yield f"if ({guard.when.attr}) {{"
        yield from self.block(guard.body)
        if guard.otherwise:
            yield "} else {"
            yield from self.block(guard.otherwise)
        yield "}"

    def words(self, loop: Compute) -> Iterator[str]:
        values = _Words(self)
        answers: list[str] = []
        results: list[str] = []
        asks, stores, back = [], [], []
        for out in sorted(loop.outs, key=lambda out: out.var.type == ANSWER):
            name = out.var.name
            if out.var.type == ANSWER:
                answers.append(name)
                asks.append(f"{name} |= ({values.of(out.value.args[0])} & valid) != 0;")
                continue
            results.append(f"o_{name}[ROUNDS]")
            own, type = (f"o_{name}[k]", "") if loop.stores_last else (f"o_{name}", "const u32 ")
            stores.append(f"{type}{own} = {values.of(out.value)} & valid;")
            back.append(f"P({self.numbers[name]})[i] = {own};")
        yield from (f"bool {name} = false;" for name in answers)
        body = ["FOR_WORDS(k, i) { PLACE(i);", *values.lines, *asks, *stores]
        if loop.stores_last:
            yield f"{{ u32 {', '.join(results)};"
            yield "\n".join([*body, "}"])
            yield f"SYNC();\nFOR_WORDS(k, i) {{ {' '.join(back)} }} }}"
        else:
            yield "\n".join([*body, *back, "}"])
        yield from (f"{name} = ANY({name});" for name in answers)

    def cells(self, loop: Compute) -> Iterator[str]:
        cells = _Cells(self, loop)
        lives, stores, ends = [], [], []
        dirty, quiet = "", []
        for out in loop.outs:
            live, number = f"n_{out.var.name}", self.numbers[out.var.name]
            value = cells.of(out.value)
            lives.append(f" u32 {live} = 0;")
            if out.var.type == REAL:
                store = f"const float v = {value}; if (inside) F({number})[cell] = v;"
                stores.append(f"{{ {store} BALLOT({live}, inside && v != 0); }}")
                ends.append(f"N({number})[i] = {live};")
                if out.otherwise is not None and out.otherwise.op == "const":  # old values must be cleared
                    dirty += f" | N({number})[i]"
                continue
            stores.append(f"BALLOT({live}, inside && {value});")
            ends.append(f"P({number})[i] = {live};")
            if out.otherwise is not None:
                quiet.append(f"P({number})[i] = {'valid' if out.otherwise.attr else '0'};")
        need = "return true;"
        if loop.region is not None:
            region = _Words(self)
            busy = region.of(loop.region)
            need = f"{' '.join(region.lines)} if (({busy}) != 0{dirty}) return true; {' '.join(quiet)} return false;"
        yield f"FOR_BUSY_WORDS(i, [&](int i) {{ PLACE(i); {need} }}) {{ PLACE(i);"
        yield "".join(lives)
        yield from (f"const u32 {name} = P({number})[i];" for number, name in cells.masks.items())
        yield from ("LANES { CELL;", *cells.lines, *stores, "}", f"ONCE {{ {' '.join(ends)} }}", "}")


class _Words(WordText):
    """Values of a word of 32 columns, each as an expression or the name of a constant."""

    type, direct = "u32", ("live",)

    def __init__(self, printer: _Printer):
        super().__init__()
        self.printer, self.layout = printer, printer.layout

    def lazy(self, node: Node) -> str:
        """A conjunction whose second part is computed only where the first holds somewhere in the word."""
        name = self.fresh("t")
        self.lines.append(f"u32 {name} = {self.known[id(node.args[0])]} & valid;")
        with self.inner() as lines:
            value = self.of(node.args[1])
        self.lines += [f"if ({name}) {{", *lines, f"{name} &= {value};", "}"]
        return name

    def row(self, dy: int) -> str:
        if ("row", dy) not in self.known:
            self.known["row", dy] = name = self.fresh("r")
            self.lines.append(f"const int {name} = row(l, y, {dy});")
        return self.known["row", dy]

    def node(self, node: Node, args: Sequence[str]) -> str:
        attr = node.attr
        if node.op in GATES:
            return GATES[node.op].format(*args)
        match node.op:
            case "load":
                return f"P({self.printer.numbers[attr]})[i]"
            case "shift":
                return self.shift(node)
            case "when":
                return self.lazy(node)
            case "const":
                return "valid" if attr else "0u"
            case "param":
                return f"PARAM_FLAG({self.layout.param_planes[param_key(node)]})"
            case "coordinate":
                axis, modulus, bit = attr
                if axis == "step":
                    return f"STEP_FLAG({self.layout.step_planes[modulus, bit]})"
                if axis == "row":
                    return f"spread(y % {modulus} >> {bit} & 1)"
                return f"COLUMNS_{self.layout.fixed[1, modulus, bit]}[w]"
            case "inside":
                return f"inside_word(y, w, {attr[0]}, {attr[1]})"
            case "chance" | "below_planes" | "below_param":
                return self.draw(node, args)
            case "live":
                number = self.printer.numbers[node.args[0].attr]
                dy, reach = attr
                return f"near(N({number}), l, y, w, {dy}, {reach})" if dy or reach else f"N({number})[i]"
        raise AssertionError(f"no cuda kernel for {node.op}")

    def shift(self, node: Node) -> str:
        dy, dx, wraps = node.attr
        plane = f"P({self.printer.numbers[node.args[0].attr]})"
        row = self.row(dy) if dy else "(i - w)"
        value = f"columns({plane} + {row}, w, {dx})" if dx else f"{plane}[{row} + w]"
        return value if wraps else f"{value} & inside_word(y, w, {dy}, {dx})"

    def draw(self, node: Node, args: Sequence[str]) -> str:
        """A draw below a limit: a number, or planes from the highest."""
        stream, bits = self.layout.streams[node.attr[0]], node.attr[1]
        where = drawn_where(node)
        wanted = "valid" if where is None else f"{self.known[id(where)]} & valid"
        if node.op == "chance":
            return f"draw_below({stream}, l, y, w, {wanted}, {bits}, {node.attr[2]}ull)"
        limit = args[: bits + 1]
        if node.op == "below_param":
            first = self.layout.limit(node)
            limit = [f"PARAM_FLAG({first + i})" for i in range(bits + 1)]
        name = self.fresh("limit")
        self.lines.append(f"const u32 {name}[] = {{{', '.join(limit)}}};")
        return f"draw_below_planes({stream}, l, y, w, {wanted}, {bits}, {name})"


class _Cells(CellValues[str]):
    """Values of one cell, which a warp computes for the 32 cells of a word; masks are tested by word."""

    def __init__(self, printer: _Printer, loop: Compute):
        super().__init__(ordered(loop.results))
        self.printer, self.layout = printer, printer.layout
        self.masks: dict[int, str] = {}
        """Words of flags by buffer, read before the cells."""

    def name(self, text: str, type: str = "float", prefix: str = "v") -> str:
        name = self.fresh(prefix)
        self.lines.append(f"const {type} {name} = {text};")
        return name

    def node(self, node: Node, args: Sequence[str]) -> str:
        attr = node.attr
        match node.op:
            case "const":
                return literal(float(attr))
            case "load" if node.type == REAL:
                return self.name(f"F({self.printer.numbers[attr]})[cell]")
            case "param":
                return self.name(f"PARAM_REAL({self.layout.param_reals[attr[0]]})")
            case "draw":
                stream, bits = attr
                return self.name(f"draw_cell({self.layout.streams[stream]}, l, y, x, {bits})")
            case "shift":
                return self.name(self.shift(node))
            case "select":
                return self.choice(node)
            case "led":
                return self.led(node)
        text = _FLOATS[node.op].format(*args, *map(literal, attr or ()))
        if text.startswith("--"):  # minus a negative number
            text = f"-({text[1:]})"
        return self.name(text, "bool", "b") if node.type == FLAG else self.name(text)

    def shift(self, node: Node) -> str:
        dy, dx, wraps = node.attr
        row, column = self.place("row", dy), self.place("column", dx)
        value = f"F({self.printer.numbers[node.args[0].attr]})[{row} + {column}]"
        if wraps:
            return value
        within = f"y + {dy} >= 0 && y + {dy} < HEIGHT && x + {dx} >= 0 && x + {dx} < WIDTH"
        return f"{within} ? {value} : 0.0f"

    def place(self, axis: str, by: int) -> str:
        """The row's first cell or the column at a neighbor."""
        if (axis, by) not in self.known:
            self.known[axis, by] = name = self.fresh("a")
            what = f"row(l, y, {by}) / ROW_WORDS * WIDTH" if axis == "row" else f"around(x, {by}, WIDTH)"
            self.lines.append(f"const int {name} = {what};")
        return self.known[axis, by]

    def mask(self, node: Node) -> str:
        if node.op == "param":
            return f"PARAM_FLAG({self.layout.param_planes[param_key(node)]})"
        return self.masks.setdefault(self.printer.numbers[node.attr], f"m{len(self.masks)}")

    def led(self, node: Node) -> str:
        """A comparison, computed only where its leader holds."""
        leader, comparison = node.args
        first = f"BIT({self.mask(leader)})" if leader.op == "load" else self.of(leader)
        with self.inner() as lines:
            value = self.of(comparison)
        name = self.fresh("b")
        self.lines += [f"bool {name} = false; if ({first}) {{", *lines, f"{name} = {value}; }}"]
        return name

    def variable(self, value: str) -> str:
        name = self.fresh("v")
        self.lines.append(f"float {name} = {value};")
        return name

    def chosen(self, mask: Node, variables: Sequence[str], values: Sequence[Node]) -> None:
        word = self.mask(mask)
        with self.inner() as lines:
            texts = [self.of(value) for value in values]
        blends = map(f"if (BIT({word})) {{}} = {{}};".format, variables, texts)
        self.lines += [f"if ({word}) {{", *lines, *blends, "}"]
