"""Values of some cells of a row of one world as C++: as many floats as a vector holds, and as many flags."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping

from powderdsl.ir.ops import REAL, Node, ordered
from powderdsl.ir.single import all_ones, divided, single
from powderdsl.schedule.types import Out
from powderdsl.targets.layout import Layout, literal, param_key
from powderdsl.targets.values import CellValues

_INFIX = {"add": "+", "sub": "-", "mul": "*"}


class Chunks(CellValues[str]):
    """Values of the cells of a chunk, in one world: floats, or flags as bits."""

    def __init__(
        self,
        layout: Layout,
        outs: tuple[Out, ...],
        waiting: Mapping[str, Callable[[str, int], str]],
        bare: frozenset[str],
        places: Mapping[str, str],
        ahead: Container[str],
    ):
        """`waiting`: where the rows of passing fields are; `bare`: those with zeros beyond the edges; `places`: the fields
        that hold the values of old ones; `ahead`: fields whose first rows are kept, since they are written over."""
        super().__init__()
        self.places, self.ahead = places, ahead
        self.layout, self.waiting, self.bare = layout, waiting, bare
        self.rows: dict[str, str] = {}
        self.words: dict[str, str] = {}
        self.choices = [node for node in ordered(out.value for out in outs) if node.op == "select"]
        self.blocks: dict[str, tuple[list[str], dict[int, str], list[str]]] = {}
        """Lines that run only where a comparison holds somewhere in the chunk, by the comparison's name."""

    def temporary(self, text: str, type: str = "F", prefix: str = "v") -> str:
        self.count += 1
        name = f"{prefix}{self.count}"
        self.lines.append(f"const {type} {name} = {text};")
        return name

    def row(self, field: str, dy: int, *, wraps: bool = True) -> str:
        """The pointer to a field's row, set up once a row."""
        self.layout.rows = max(self.layout.rows, abs(dy))
        field = self.places.get(field, field)
        if field in self.waiting:
            call = self.waiting[field](field, dy)
        elif wraps and dy > 0 and field in self.ahead:
            call = f"(y + {dy} < rows ? real_line(c, v{field}, base + y + {dy}, nothing) : first{field}[y + {dy} - rows])"
        elif wraps or not dy:
            call = f"real_line(c, v{field}, base + {f'lines[y + {dy}]' if dy else 'y'}, nothing)"
        else:
            call = f"real_line_or_nothing(c, v{field}, base, y + {dy}, rows, nothing)"
        return self.rows.setdefault(call, f"r{len(self.rows)}")

    def word(self, node: Node) -> str:
        """The word of a flag's plane, read once per row and word."""
        if node.op == "param":
            return f"c.param_bits[{self.layout.param_planes[param_key(node)]}][l]"
        return self.words.setdefault(str(node.attr), f"m{len(self.words)}")

    def mask(self, node: Node) -> str:
        """The bits of a chunk in a flag's plane."""
        return f"(u32)({self.word(node)} >> (x & (BITS - 1)) & ALL)"

    def node(self, node: Node) -> str:
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
            case "shift":
                dy, dx, wraps = attr
                field = str(node.args[0].attr)
                loaded = f"load({self.row(field, dy, wraps=wraps)}, x + {dx})"
                within = wraps or not dx or field in self.bare
                self.layout.reach = max(self.layout.reach, abs(dx) if wraps or within else 0)
                return self.temporary(loaded if within else f"inside_columns({loaded}, x, {dx}, width)")
        args = [self.known[id(arg)] for arg in node.args]
        match node.op:
            case "eq" | "lt" | "le":
                return self.temporary(f"bits_{node.op}({args[0]}, {args[1]})", "u32", "b")
            case "add" | "sub" | "mul":
                return self.temporary(f"{args[0]} {_INFIX[node.op]} {args[1]}")
            case "div" if node.args[1].op == "const" and node.args[1].attr:
                return self.temporary(quotient(args[0], float(node.args[1].attr)))
            case "div":
                return self.temporary(f"divide({args[0]}, {args[1]})")
            case "neg":
                return self.temporary(f"-{args[0]}")
            case "abs" | "min" | "max" | "sqrt":
                call = {"abs": "magnitude", "min": "smaller", "max": "larger", "sqrt": "root"}[node.op]
                return self.temporary(f"{call}({', '.join(args)})")
            case "settle":
                lo, hi = attr
                return self.temporary(f"settle({args[0]}, {literal(lo)}, {literal(hi)}, SNAP)")
        raise AssertionError(f"no C++ kernel for {node.op}")

    def draw(self, node: Node) -> str:
        stream, bits = node.attr
        self.count += 1
        name = f"d{self.count}"
        cell = f"draw_cell(c, {self.layout.streams[stream]}, lane, row, std::min(x + i, width - 1), {bits})"
        self.lines.append(f"F {name}; for (int i = 0; i < CHUNK; i++) {name}[i] = {cell};")
        return name

    def led(self, node: Node) -> str:
        """A comparison, computed only where its leader holds somewhere in the chunk."""
        leader, comparison = node.args
        first = self.of(leader)
        self.count += 1
        name = f"b{self.count}"
        self.lines.append(f"u32 {name} = 0;")
        lines, known, ends = self.blocks.setdefault(first, ([], dict(self.known), []))
        outer, before = self.lines, self.known
        self.lines, self.known = lines, known
        value = self.of(comparison)
        self.lines, self.known = outer, before
        ends.append(f"{name} = {value} & {first};")
        return name

    def close(self) -> None:
        """Append the lines that depend on comparisons."""
        for first, (lines, _, ends) in self.blocks.items():
            self.lines.append(f"if ({first}) {{ {' '.join([*lines, *ends])} }}")

    def choice(self, node: Node) -> None:
        """A chain of choices. A choice is computed only if it chooses some cell of the chunk."""
        chains = self.alike(node)
        masks = [choice.args[0] for choice in chains[0]]
        names = []
        for one in chains:
            base = self.of(one[-1].args[2])
            self.count += 1
            names.append(f"v{self.count}")
            self.lines.append(f"F {names[-1]} = {base};")
        for level in reversed(range(len(masks))):
            self.count += 1
            bits = f"b{self.count}"
            outer, before = self.lines, self.known
            running = {id(one[level].args[2]): name for one, name in zip(chains, names, strict=True)}
            self.lines, self.known = [], before | running  # valid only here, since the variables change
            chosen = [self.of(one[level].args[1]) for one in chains]
            blends = [
                f"{name} = blend({bits}, {value}, {name});" for name, value in zip(names, chosen, strict=True)
            ]
            inner, self.lines, self.known = self.lines, outer, before
            self.lines.append(
                f"if (const u32 {bits} = {self.mask(masks[level])}) {{ {' '.join([*inner, *blends])} }}"
            )
        for one, name in zip(chains, names, strict=True):
            self.known[id(one[0])] = name


def quotient(value: str, divisor: float) -> str:
    """A division by a constant; a product, unless the divisor's fraction is all ones (Markstein 1990, theorem 8)."""
    if all_ones(divisor) or not 2.0**-60 < abs(divisor) < 2.0**60:
        return f"{value} / splatf({literal(divisor)})"
    return f"divide_by({value}, {literal(divisor)}, {literal(divided(1.0, single(divisor)))})"
