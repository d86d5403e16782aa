"""IR on planes -> the Python source of one pass: packed words for flags, float32 cells for reals."""

from __future__ import annotations

from powderdsl.backends.dense_source import comment, with_deletions
from powderdsl.ir.ops import REAL, Node, PassGraph, nodes_of

_WORDS = {"and": "&", "or": "|", "xor": "^"}
_REALS = {"add": "+", "sub": "-", "mul": "*"}
_COMPARE = {"eq": "==", "lt": "<", "le": "<="}


class _Writer:
    """Lines of a pass. Swaps by the same movers are done on all their planes at once."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.constants: dict[str, float] = {}
        self.names: dict[int, str] = {}
        self.cells: dict[str, str] = {}
        self.count = 0

    def fresh(self, prefix: str = "n") -> str:
        self.count += 1
        return f"{prefix}{self.count}"

    def name(self, node: Node) -> str:
        return self.names[id(node)]

    def dense(self, flag: Node) -> str:
        """A flag as bool cells, unpacked once."""
        words = self.name(flag)
        if words not in self.cells:
            self.cells[words] = self.fresh("s")
            self.lines.append(f"{self.cells[words]} = k.unpack({words})")
        return self.cells[words]

    def emit(self, node: Node, expression: str) -> None:
        self.names[id(node)] = name = self.fresh()
        self.lines.append(f"{name} = {expression}")

    def node(self, node: Node) -> None:
        args = node.args
        attr = node.attr
        real = node.type == REAL
        match node.op:
            case "input":
                self.emit(node, f"state[{attr!r}]")
            case "const" if real:
                name = f"c{len(self.constants)}"
                self.constants[name] = float(attr)
                self.names[id(node)] = name
            case "const":
                self.emit(node, "k.valid" if attr else "k.zero")
            case "param":
                self.emit(node, f"k.param({', '.join(map(repr, attr))})")
            case "coordinate":
                self.emit(node, f"k.coordinate({', '.join(map(repr, attr))})")
            case "inside":
                self.emit(node, f"k.inside({attr[0]}, {attr[1]})")
            case "chance":
                self.emit(node, f"k.chance({attr[0]!r}, {attr[1]}, {attr[2]})")
            case "below_planes":
                planes = ", ".join(self.name(arg) for arg in args)
                self.emit(node, f"k.below({attr[0]!r}, {attr[1]}, ({planes},))")
            case "draw":
                self.emit(node, f"k.draw_real({attr[0]!r}, {attr[1]})")
            case "shift":
                dy, dx, wraps = attr
                call = "k.shift_cells" if real else "k.shift"
                self.emit(node, f"{call}({self.name(args[0])}, {dy}, {dx}, {wraps})")
            case "not":
                self.emit(node, f"{self.name(args[0])} ^ k.valid")
            case "and" | "or" | "xor":
                self.emit(node, f"{self.name(args[0])} {_WORDS[node.op]} {self.name(args[1])}")
            case "eq" | "lt" | "le":
                self.emit(node, f"k.pack({self.name(args[0])} {_COMPARE[node.op]} {self.name(args[1])})")
            case "add" | "sub" | "mul":
                self.emit(node, f"{self.name(args[0])} {_REALS[node.op]} {self.name(args[1])}")
            case "div":
                self.emit(node, f"k.divide({self.name(args[0])}, {self.name(args[1])})")
            case "neg":
                self.emit(node, f"-{self.name(args[0])}")
            case "abs":
                self.emit(node, f"{self.name(args[0])}.abs()")
            case "min" | "max":
                self.emit(node, f"torch.{node.op}imum({self.name(args[0])}, {self.name(args[1])})")
            case "sqrt":
                # torch's float32 square root is not always rounded correctly on CPUs; from float64 it is.
                self.emit(node, f"torch.sqrt({self.name(args[0])}.double()).float()")
            case "settle":
                self.emit(node, f"k.settle({self.name(args[0])}, {attr[0]!r}, {attr[1]!r})")
            case "select" if real:
                self.emit(
                    node, f"torch.where({self.dense(args[0])}, {self.name(args[1])}, {self.name(args[2])})"
                )
            case "select":
                condition, yes, no = map(self.name, args)
                self.emit(node, f"{no} ^ ({condition} & ({yes} ^ {no}))")
            case "swap" | "arrive":
                self.movement([node])
            case _:
                raise AssertionError(f"no plane kernel for {node.op}")

    def movement(self, group: list[Node]) -> None:
        """Swaps or arrivals of several planes with the same movers and offset."""
        first = group[0]
        dy, dx = first.attr
        if first.type == REAL:
            for node in group:
                content, movers, rest = node.args
                call = f"k.{node.op}_cells({self.name(content)}, {self.dense(movers)}, {self.name(rest)}, {dy}, {dx})"
                self.emit(node, call)
            return
        contents = ", ".join(self.name(node.args[0]) for node in group)
        rests = ", ".join(self.name(node.args[2]) for node in group)
        same = contents == rests
        results = []
        for moved in group:
            self.names[id(moved)] = self.fresh()
            results.append(self.names[id(moved)])
        who = self.name(first.args[1])
        given = "None" if same else f"({rests},)"
        self.lines.append(f"{', '.join(results)}, = k.{first.op}(({contents},), {who}, {given}, {dy}, {dx})")


def _grouped(nodes: list[Node]) -> list[list[Node]]:
    """Nodes in order, movements that can be done together in one group at the place of the last."""
    key_of = {id(n): (n.op, id(n.args[1]), n.attr, n.type.name) for n in nodes if n.op in ("swap", "arrive")}
    depth: dict[int, int] = {}
    for node in nodes:
        depth[id(node)] = max((depth[id(arg)] for arg in node.args), default=0) + (
            node.op in ("swap", "arrive")
        )
    groups: dict[object, list[Node]] = {}
    for node in nodes:
        if id(node) in key_of:
            groups.setdefault((key_of[id(node)], depth[id(node)]), []).append(node)
    # By depth in movements: whatever a group needs lies in lower depths, or in its own before any movement.
    ordered: list[list[Node]] = []
    for level in range(max(depth.values(), default=0) + 1):
        ordered += [group for key, group in groups.items() if key[1] == level]  # type: ignore[index]
        ordered += [[node] for node in nodes if depth[id(node)] == level and id(node) not in key_of]
    return ordered


def planes_pass_source(pass_: PassGraph, number: int) -> tuple[str, str, dict[str, float]]:
    """Source, function name and constants of a pass."""
    writer = _Writer()
    place = ""
    for group in _grouped(nodes_of(pass_, moments=False)):
        node = group[0]
        if node.places and node.places[0] != place:
            place = node.places[0]
            writer.lines.append(f"# {comment(place)}")
        if len(group) > 1:
            writer.movement(group)
        else:
            writer.node(node)
    name = f"pass_{number}"
    returned = ", ".join(f"{slot!r}: {writer.name(node)}" for slot, node in pass_.outputs)
    lines = with_deletions(writer.lines, returned)
    body = [f"def {name}(k, state):", *(f"    {line}" for line in lines), f"    return {{{returned}}}"]
    header = [
        f"# {comment(pass_.name)}",
        *(f"# {key} = {value!r}" for key, value in writer.constants.items()),
    ]
    return "\n".join(header + body) + "\n", name, writer.constants
