"""Values of one pass as C++ variables: each node is computed once, after what it needs, into a plane or a field."""

from __future__ import annotations

from dataclasses import replace

from powderdsl.ir.ops import FLAG, REAL, Node, PassGraph, walk
from powderdsl.targets.cpp.blocks import Block, Lanes, lane_loop
from powderdsl.targets.cpp.lanes import sweep_lanes
from powderdsl.targets.cpp.layers import choices, layer_lanes
from powderdsl.targets.cpp.loops import ANCHORS, Loop, is_uniform, prerequisites, zero_with
from powderdsl.targets.cpp.sweeps import Sweep, leading, quiet, stored_parts, sweep_needs, unchanged
from powderdsl.targets.layout import Layout


class ValueWriter:
    """Variables of a pass, and the statements that fill them."""

    def __init__(self, pass_: PassGraph, layout: Layout):
        self.pass_, self.layout = pass_, layout
        self.planes: dict[int, str] = {}
        self.fields: dict[int, str] = {}
        self.block = Block()
        self.targets: dict[tuple[int, int, int], str] = {}
        self.count = 0
        self.active = 0
        nodes = list({id(n): n for _, root in pass_.outputs for n in walk(root)}.values())
        self.alive = {id(n) for n in nodes}
        self.all_comparisons = [n for n in nodes if n.op in ("eq", "lt", "le")]
        shifts = [n for n in nodes if n.op == "shift" and n.type == REAL]
        sources = [p for n in shifts for p in (stored_parts(n.args[0], _is_input) if n.attr[2] else n.args)]
        self.stored = {id(part) for part in sources if part.op != "input"}
        self.leaders = {
            id(n): leader for n in self.all_comparisons if (leader := leading(n, self.all_comparisons, pass_))
        }
        self.input_nodes = {id(n): n for n in nodes if n.op == "input"}
        self.slot_of = {key: str(n.attr) for key, n in self.input_nodes.items()}

    # Variables

    def fresh(self, prefix: str) -> str:
        self.count += 1
        name = f"{prefix}{self.count}"
        self.block.defined.append(name)
        return name

    def have(self, node: Node) -> bool:
        return id(node) in self.planes or id(node) in self.fields

    def have_input(self, node: Node) -> None:
        """Slots that the pass reads: borrowed from the context."""
        if node.op != "input" or self.have(node):
            return
        if node.type == REAL:
            self.fields[id(node)] = name = self.fresh("f")
            self.block.statements.append(
                f"Field* {name} = keep(c.real[{self.layout.reals[str(node.attr)]}]);"
            )
        else:
            self.planes[id(node)] = name = self.fresh("p")
            self.block.statements.append(
                f"Plane* {name} = keep(c.slot[{self.layout.planes[str(node.attr)]}]);"
            )

    def inputs(self, nodes: list[Node]) -> None:
        for node in nodes:
            for inner in walk(node):
                self.have_input(inner)

    def needs(self, node: Node) -> list[Node]:
        return [node] if node.op in ANCHORS and not self.have(node) else prerequisites(node, self.have)

    # Values in planes

    def ensure(self, nodes: list[Node]) -> None:
        """Put nodes into planes or fields, with everything they need before them."""
        wanted = [
            node
            for node in dict.fromkeys(nodes)
            if not self.have(node) and not (is_uniform(node) and node.type == REAL)
        ]
        if not wanted:
            return
        before: list[Node] = []
        for node in wanted:
            before += self.direct_needs(node)
        before = [node for node in dict.fromkeys(before) if not self.have(node)]
        if before:
            self.ensure(before)
            self.ensure(wanted)
            return
        reals = [n for n in wanted if n.type == REAL or n.op in ("eq", "lt", "le")]
        # What neighbours will be asked for later is stored while it is computed anyway.
        reals += [
            i for n in reals for i in walk(n) if id(i) in self.stored and not self.have(i) and i not in reals
        ]
        reals = list(dict.fromkeys(reals))
        laid = [n for n in reals if self.is_laid(n)]
        moves = [n for n in wanted if n.op in ("swap", "arrive") and n.type == FLAG]
        loops = [n for n in wanted if n not in reals and n not in moves]
        if laid:
            self.lay(laid)
        if reals := [n for n in reals if n not in laid]:
            self.sweep(reals)
        if loops:
            self.loop(loops)
        for node in moves:
            self.movement(node)

    def direct_needs(self, node: Node) -> list[Node]:
        if node.type == REAL or node.op in ("eq", "lt", "le"):
            if self.is_laid(node):
                chain = choices(node, self.have)
                parts = [part for choice in chain for part in sweep_needs(choice.args[1], self.have)]
                needs = [choice.args[0] for choice in chain] + [need for part in parts for need in part]
                return [
                    need for need in (*needs, chain[-1].args[2]) if not self.have(need) and need not in chain
                ]
            flags, reals = sweep_needs(
                node, self.have, self.is_laid if not unchanged(node) else lambda _: False
            )
            return [*flags, *reals]
        if node.op in ("swap", "arrive"):
            content, movers, rest = node.args
            return [arg for arg in (content, movers, rest) if not self.have(arg)]
        return prerequisites(node, self.have)

    def target_plane(self, movers: Node, dy: int, dx: int) -> str:
        """Movers seen from their targets: shared by all planes that move."""
        key = (id(movers), dy, dx)
        if self.targets.get(key) not in self.block.defined:
            name = self.fresh("p")
            self.block.statements.append(
                f"Plane* {name} = shifted(c, {self.planes[id(movers)]}, {-dy}, {-dx});"
            )
            self.targets[key] = name
        return self.targets[key]

    def movement(self, node: Node) -> None:
        content, movers, rest = node.args
        dy, dx = node.attr
        target = self.target_plane(movers, dy, dx)
        name = self.fresh("p")
        a, m, b = (self.planes[id(arg)] for arg in (content, movers, rest))
        if node.op == "swap":
            call = f"swap_plane(c, {a}, {m}, {target}, {b}, {dy}, {dx})"
        else:
            call = f"arrive_plane(c, {a}, {target}, {b}, {dy}, {dx})"
        self.block.statements.append(f"Plane* {name} = {call};")
        self.planes[id(node)] = name

    def loop(self, nodes: list[Node]) -> None:
        rest = []
        for node in nodes:
            call = self.simple(node)
            if call:
                name = self.fresh("p")
                self.block.statements.append(f"Plane* {name} = {call};")
                self.planes[id(node)] = name
            else:
                rest.append(node)
        if rest:
            loop = Loop(self.planes, self.layout)
            outputs = [(self.fresh("p"), loop.clean(node)) for node in rest]
            self.emit_loop(loop, outputs, [zero_with(node, self.planes) for node in rest])
            for node, (name, _) in zip(rest, outputs, strict=True):
                self.planes[id(node)] = name

    def simple(self, node: Node) -> str | None:
        """Whole-plane operations that see at once when there is nothing to do."""
        if node.op == "shift" and node.attr[2] and self.have(node.args[0]):
            dy, dx, _ = node.attr
            return f"shifted(c, {self.planes[id(node.args[0])]}, {dy}, {dx})"
        if node.op == "and":
            for kept, gone in (node.args, node.args[::-1]):
                if gone.op == "not" and self.have(gone.args[0]) and self.have(kept):
                    return f"cleared(c, {self.planes[id(kept)]}, {self.planes[id(gone.args[0])]})"
        if node.op == "or" and all(self.have(arg) for arg in node.args):
            return f"joined(c, {self.planes[id(node.args[0])]}, {self.planes[id(node.args[1])]})"
        if node.op == "const" and not node.attr:
            return "keep(c.nothing)"
        return None

    def emit_loop(
        self,
        loop: Loop,
        outputs: list[tuple[str, str]],
        empty: list[frozenset[str] | None] | None = None,
        absent: str = "",
    ) -> None:
        """A loop that fills planes. `empty`: planes of which it is known that if they are empty, so is the output;
        `absent`: a condition in C++ under which all outputs are."""
        takes = " ".join(f"{name} = take(c); V a{name} = splat(0);" for name, _ in outputs)
        declared = "Plane " + ", ".join(f"*{name}" for name, _ in outputs) + ";\n"
        conditions = [absent] if absent else []
        if empty and all(names is not None for names in empty):
            zero = sorted({f"{name}->zero" for names in empty for name in names or ()})
            conditions.append(f"({' && '.join(zero) or 'true'})")
        nothing = ""
        if conditions:
            without = " ".join(f"{name} = keep(c.nothing);" for name, _ in outputs)
            nothing = f"if ({' || '.join(conditions)}) {{ {without} }} else "
        stores = "\n".join(
            f"{{ const V o = {value}; {name}->data[i] = o; a{name} |= o; }}" for name, value in outputs
        )
        ends = " ".join(f"{name}->zero = !any(a{name});" for name, _ in outputs)
        body = "\n".join(loop.lines)
        self.block.statements.append(
            f"{declared}{nothing}{{\n{loop.ready()}\n{takes}\n"
            "for (int y = 0, i = 0; y < height; y++) for (int w = 0; w < words; w++, i++) { const V valid = c.valid(w); (void)valid;\n"
            f"{body}\n{stores}\n}}\n{ends}\n}}"
        )

    # Reals

    def sweep(self, nodes: list[Node]) -> None:
        """Compute reals and comparisons for each world, row by row; rows where nothing is going on are skipped."""
        # A comparison that others are asked only together with comes before them.
        leaders = {id(leader) for leader in self.leaders.values()}
        nodes = sorted(nodes, key=lambda n: (n.type != REAL, id(n) not in leaders))
        values, masks, _ = quiet(nodes, self.have)
        sweep = Sweep(self.planes, self.fields, self.layout)
        sweep.wanted = [
            n
            for n in dict.fromkeys(i for node in nodes if node.type == REAL for i in walk(node))
            if n.op == "select" and n.type == REAL
        ]
        outputs = []
        for node in nodes:
            if node.type == REAL:
                name = self.fresh("f")
                outputs.append((node, name, sweep.value(node)))
            else:
                name = self.fresh("p")
                outputs.append((node, name, sweep.comparison(node, self.leaders)))
        sweep.close()
        lanes = sweep_lanes(outputs, sweep, values, masks)
        kept = [found for node in nodes if (found := unchanged(node)) is not None]
        if len(kept) == len(nodes) and all(self.have(base) for base, _ in kept):
            self.changed_rows(outputs, kept, lanes)
        else:
            self.block.statements.append(lanes)
        for node, name, _ in outputs:
            (self.fields if node.type == REAL else self.planes)[id(node)] = name

    def is_laid(self, node: Node) -> bool:
        """Whether a real is made of choices laid over each other."""
        return node.type == REAL and node.op == "select" and bool(choices(node, self.have))

    def lay(self, nodes: list[Node]) -> None:
        """Choices in fields of their own; those that hang on the same masks together."""
        groups: dict[tuple[int, ...], list[list[Node]]] = {}
        for node in nodes:
            chain = choices(node, self.have)
            groups.setdefault(tuple(id(choice.args[0]) for choice in chain), []).append(chain)
        for chains in groups.values():
            names = [self.fresh("f") for _ in chains]
            lanes = layer_lanes(chains, names, self.planes, self.fields, self.layout, self.active)
            self.active += len(chains[0]) + 1
            self.block.statements.append(lanes)
            self.fields.update({id(chain[0]): name for chain, name in zip(chains, names, strict=True)})

    def changed_rows(
        self, outputs: list[tuple[Node, str, str]], kept: list[tuple[Node, list[Node]]], sweep: Lanes
    ) -> None:
        """Settled slots under choices stay as they are in rows where no choice holds."""
        masks = {id(mask): self.planes[id(mask)] for _, chosen in kept for mask in chosen}.values()
        scan = " | ".join(f"((const u64*){plane}->data)[(y * words + w) * LANES + l]" for plane in masks)
        pairs = [(name, self.fields[id(base)]) for (_, name, _), (base, _) in zip(outputs, kept, strict=True)]
        copies = " ".join(f"some{name} |= copy_row(c, {name}, {base}, l, y);" for name, base in pairs)
        still = f"{{ u64 some = 0; for (int w = 0; w < words; w++) some |= {scan or 0}; if (!some) {{ {copies} continue; }} }}\n"
        self.block.statements.append(
            lane_loop([replace(sweep, rows=still + sweep.rows, asked=None)], sweep.fields)
        )


def _is_input(node: Node) -> bool:
    return node.op == "input"
