"""One pass as C++: moment after moment, each skipped where its masks are empty; values live as long as they are needed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

from powderdsl.backends.native_blocks import Block, Lanes, lane_loop
from powderdsl.backends.native_lanes import sweep_lanes
from powderdsl.backends.native_layers import choices, layer_lanes
from powderdsl.backends.native_layout import Layout
from powderdsl.backends.native_loops import (
    ANCHORS,
    DRAWS,
    Loop,
    is_clean,
    is_uniform,
    prerequisites,
    zero_with,
)
from powderdsl.backends.native_moves import Movement, depends, move_calls, movements
from powderdsl.backends.native_sweeps import (
    Sweep,
    leading,
    quiet,
    stored_parts,
    sweep_needs,
    unchanged,
)
from powderdsl.ir.ops import FLAG, REAL, Node, PassGraph, Step, walk


class PassWriter:
    """Writes `static void pass_N(Context& c)`."""

    def __init__(self, pass_: PassGraph, number: int, layout: Layout):
        self.pass_, self.number, self.layout = pass_, number, layout
        self.planes: dict[int, str] = {}
        self.fields: dict[int, str] = {}
        self.block = Block()
        self.targets: dict[tuple[int, int, int], str] = {}
        self.count = 0
        self.active = 0
        nodes = list({id(n): n for _, root in pass_.outputs for n in walk(root)}.values())
        self.alive = {id(n) for n in nodes}
        self.all_comparisons = [n for n in nodes if n.op in ("eq", "lt", "le")]
        nothing = lambda node: node.op == "input"  # noqa: E731
        shifts = [n for n in nodes if n.op == "shift" and n.type == REAL]
        sources = [p for n in shifts for p in (stored_parts(n.args[0], nothing) if n.attr[2] else n.args)]
        self.stored = {id(part) for part in sources if part.op != "input"}
        self.leaders = {
            id(n): leader for n in self.all_comparisons if (leader := leading(n, self.all_comparisons, pass_))
        }
        self.input_nodes = {id(n): n for n in nodes if n.op == "input"}
        asked = Counter(
            key
            for step in pass_.moments
            for guard in dict.fromkeys(step.guards)
            for key in {id(part) for part in _conjunctions(guard)}
        )
        self.shared = {key for key, count in asked.items() if count > 1}
        """Parts of several masks: where such a plane is empty, all of them are."""
        self.slot_of = {key: str(n.attr) for key, n in self.input_nodes.items()}

    def source(self) -> str:
        current: dict[str, Node] = {}
        self.borrow()
        for step in self.pass_.moments:
            self.moment(step, current)
            current.update(step.writes)
        self.finish()
        body = self.block.text()
        return f"// pass {self.number}\nOUTLINE void pass_{self.number}(Context& c) {{\nconst int words = c.g.words, height = c.g.height, width = c.g.width; (void)words; (void)height; (void)width;\n{body}\n}}"

    # Variables

    def fresh(self, prefix: str) -> str:
        self.count += 1
        name = f"{prefix}{self.count}"
        self.block.defined.append(name)
        return name

    def have(self, node: Node) -> bool:
        return id(node) in self.planes or id(node) in self.fields

    def borrow(self) -> None:
        """Slots that the pass both reads and writes: nobody else holds their planes while it runs."""
        written = {slot for slot, _ in self.pass_.outputs}
        for key, node in self.input_nodes.items():
            if node.type != REAL and self.slot_of[key] in written:
                self.planes[key] = name = self.fresh("p")
                place = f"c.slot[{self.layout.planes[self.slot_of[key]]}]"
                self.block.statements.append(f"Plane* {name} = {place}; {place} = nullptr;")

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

    # Moments

    def moment(self, step: Step, current: dict[str, Node]) -> None:
        writes = [
            (slot, node)
            for slot, node in step.writes
            if id(node) in self.alive and node.type != REAL and not self.have(node)
        ]
        guards = [guard for guard in step.guards if guard.op != "const"]
        if not writes:
            return
        self.comparisons(guards)
        unknown = [node for slot, node in writes if slot not in current and slot not in self.layout.planes]
        if unknown:  # a scratch field's first write: what it held is not in a plane
            self.inputs(unknown)
            self.ensure(unknown)
            writes = [(slot, node) for slot, node in writes if not self.have(node)]
            if not writes:
                return
        if not guards or any(g.op == "const" for g in step.guards) or any(is_uniform(g) for g in guards):
            self.inputs([node for _, node in writes])
            self.ensure([node for _, node in writes])
            return
        self.inputs([*guards, *(node for _, node in writes)])
        condition = self.guards(guards)
        olds = {id(node): self.old(slot, current.get(slot)) for slot, node in writes}
        moved = movements([node for _, node in writes], [self.before(slot, current) for slot, _ in writes])
        carried = [node for _, node in writes if id(node) in moved]
        others = [node for _, node in writes if id(node) not in moved]
        if depends(others, moved):
            self.move(carried, moved, olds)
            self.change(others, olds, condition)
        else:
            self.change(others, olds, condition)
            self.move(carried, moved, olds)

    def before(self, slot: str, current: dict[str, Node]) -> Node | None:
        """The node that a slot holds before a moment."""
        if slot in current:
            return current[slot]
        return next((self.input_nodes[i] for i in self.slot_of if self.slot_of[i] == slot), None)

    def move(self, nodes: list[Node], moved: dict[int, Movement], olds: dict[int, str]) -> None:
        """Carry planes along, in place where nothing else needs what they held."""
        if not nodes:
            return
        movers = moved[id(nodes[0])].movers
        self.ensure([movers])
        self.layout.moving = max(self.layout.moving, len(nodes))
        names = {id(node): self.fresh("p") for node in nodes}
        self.block.statements.append(" ".join(f"Plane* {name} = keep({olds[key]});" for key, name in names.items()))
        rows = [(name, moved[key]) for key, name in names.items()]
        self.block.statements.append(move_calls(rows, self.planes[id(movers)]))
        self.planes.update(names)

    def change(self, nodes: list[Node], olds: dict[int, str], condition: str) -> None:
        """New planes or fields, if any mask of the moment holds anywhere; the old ones otherwise."""
        if not nodes:
            return
        kind, prefix = ("Field", "f") if nodes[0].type == REAL else ("Plane", "p")
        names = {id(node): self.fresh(prefix) for node in nodes}
        outer = (self.planes, self.fields, self.block)
        self.planes, self.fields, self.block = dict(self.planes), dict(self.fields), Block()
        self.ensure(nodes)
        made = self.fields if kind == "Field" else self.planes
        for key, name in names.items():
            self.block.statements.append(f"{name} = keep({made[key]});")
        text = self.block.text()
        self.planes, self.fields, self.block = outer
        declared = ", ".join(f"*{name}" for name in names.values())
        otherwise = " ".join(f"{name} = keep({olds[key]});" for key, name in names.items())
        self.block.statements.append(
            f"{kind} {declared};\nif ({condition}) {{\n{text}\n}} else {{ {otherwise} }}"
        )
        (self.fields if kind == "Field" else self.planes).update(names)

    def comparisons(self, guards: list[Node]) -> None:
        """Comparisons of reals that masks ask for, outside any branch, with all others that can be had in one sweep."""
        asked = [
            n for guard in guards for n in walk(guard) if n.op in ("eq", "lt", "le") and not self.have(n)
        ]
        if not asked:
            return
        self.inputs(asked)
        self.ensure([need for node in asked for need in self.direct_needs(node)])
        others = [n for n in self.all_comparisons if not self.have(n) and n not in asked]
        self.inputs([n for n in others if not self.direct_needs_unless_input(n)])
        ready = [
            n
            for n in others
            if not self.direct_needs(n) and all(self.have(i) for i in walk(n) if i.op == "input")
        ]
        self.ensure([*asked, *ready])

    def direct_needs_unless_input(self, node: Node) -> list[Node]:
        return [need for need in self.direct_needs(node) if need.op != "input"]

    def old(self, slot: str, node: Node | None) -> str:
        """The plane that holds a slot's value before the moment."""
        if node is None:
            return self.input_plane(slot)
        if not self.have(node):
            if node.op == "const" and not node.attr:
                return "c.nothing"
            self.inputs([node])
            self.ensure([node])
        return self.planes[id(node)]

    def input_plane(self, slot: str) -> str:
        for node_id, name in self.planes.items():
            if self.slot_of.get(node_id) == slot:
                return name
        name = self.fresh("p")
        self.block.statements.append(f"Plane* {name} = keep(c.slot[{self.layout.planes[slot]}]);")
        return name

    def guards(self, guards: list[Node]) -> str:
        """Masks of a moment in planes: first what is cheap, and the rest only where that leaves something."""
        guards = list({id(g): g for g in guards}.values())
        open_guards = [g for g in guards if not self.have(g)]
        self.ensure([g for g in open_guards if g.op in ANCHORS])
        self.ensure([part for guard in open_guards for part in self.shared_parts(guard)])
        open_guards = [g for g in open_guards if not self.have(g)]
        staged = [(g, *self.split(g)) for g in open_guards]
        if not any(rest for _, _, rest in staged) or not all(cheap for _, cheap, _ in staged):
            self.ensure(open_guards)
            return " || ".join(f"!{self.planes[id(g)]}->zero" for g in guards)
        candidates = {id(g): self.fresh("p") for g, _, rest in staged if rest}
        loop = Loop(self.planes, self.layout)
        outputs = []
        empty = []
        for guard, cheap, rest in staged:
            parts = [loop.value(part) for part in cheap]
            known = [names for part in cheap if (names := zero_with(part, self.planes)) is not None]
            empty.append(min(known, key=len, default=None))
            name = candidates[id(guard)] if rest else self.fresh("p")
            if not rest:
                self.planes[id(guard)] = name
            clean = any(is_clean(part, self.have) for part in cheap)
            outputs.append((name, " & ".join(parts) if clean else " & ".join([*parts, "valid"])))
        self.emit_loop(loop, outputs, empty)
        condition = " || ".join(
            f"!{name}->zero"
            for name in (*candidates.values(), *(self.planes[id(g)] for g in guards if self.have(g)))
        )
        rest_guards = [(g, rest) for g, _, rest in staged if rest]
        names = {id(g): self.fresh("p") for g, _ in rest_guards}
        outer = (self.planes, self.fields, self.block)
        self.planes, self.fields, self.block = dict(self.planes), dict(self.fields), Block()
        self.ensure([need for _, rest in rest_guards for part in rest for need in self.needs(part)])
        lines = []
        loop = Loop(self.planes, self.layout)
        for guard, rest in rest_guards:
            candidate = candidates[id(guard)]
            inner = loop.inner()
            wanted = f"w{names[id(guard)]}"
            value = wanted
            for part in sorted(rest, key=lambda part: part.op in DRAWS):
                if part.op in DRAWS and not inner.have(part):
                    expression = inner.draw(part, value)
                else:
                    expression = f"{value} & {inner.value(part)}"
                inner.counter[0] += 1
                value = f"t{inner.counter[0]}"
                inner.lines.append(f"const V {value} = {expression};")
            body = " ".join(inner.lines)
            target = names[id(guard)]
            lines.append(
                f"const V {wanted} = {candidate}->data[i]; V g{target} = splat(0);\n"
                f"if (any({wanted})) {{ {body} g{target} = {value}; }}\n{target}->data[i] = g{target}; a{target} |= g{target};"
            )
        takes = " ".join(f"{name} = take(c); V a{name} = splat(0);" for name in names.values())
        ends = " ".join(f"{name}->zero = !any(a{name});" for name in names.values())
        self.block.statements.append(
            f"{takes}\nfor (int y = 0, i = 0; y < height; y++) for (int w = 0; w < words; w++, i++) {{ const V valid = c.valid(w); (void)valid;\n"
            + "\n".join(lines) + f"\n}}\n{ends}"
        )  # fmt: skip
        text = self.block.text()
        self.planes, self.fields, self.block = outer
        declared = ", ".join(f"*{name}" for name in names.values())
        otherwise = " ".join(f"{name} = keep(c.nothing);" for name in names.values())
        self.block.statements.append(
            f"Plane {declared};\nif ({condition}) {{\n{text}\n}} else {{ {otherwise} }}"
        )
        self.planes.update(names)
        return " || ".join(f"!{self.planes[id(g)]}->zero" for g in guards)

    def shared_parts(self, guard: Node) -> list[Node]:
        """The largest parts of a mask that other masks have too, if one loop can compute them."""
        if self.have(guard) or guard.op in ("input", "not"):
            return []
        if id(guard) in self.shared and not is_uniform(guard) and not prerequisites(guard, self.have):
            if not any(inner.op in (*DRAWS, *ANCHORS) for inner in walk(guard)):
                return [guard]
        return [part for arg in guard.args for part in self.shared_parts(arg)] if guard.op == "and" else []

    def split(self, guard: Node) -> tuple[list[Node], list[Node]]:
        """Conjuncts that one loop can compute from what is there, and those that take more."""
        cheap: list[Node] = []
        rest: list[Node] = []
        for part in _conjuncts(guard, self.have):
            free = self.have(part) or (not prerequisites(part, self.have) and part.op not in ANCHORS)
            draws = any(n.op in DRAWS for n in walk(part)) and not self.have(part)
            (cheap if free and not draws else rest).append(part)
        return cheap, rest

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
                return [need for need in (*needs, chain[-1].args[2]) if not self.have(need) and need not in chain]
            flags, reals = sweep_needs(node, self.have, self.is_laid if not unchanged(node) else lambda _: False)
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
        self, loop: Loop, outputs: list[tuple[str, str]], empty: list[frozenset[str] | None] | None = None
    ) -> None:
        """A loop that fills planes. `empty`: planes of which it is known that if they are empty, so is the output."""
        takes = " ".join(f"{name} = take(c); V a{name} = splat(0);" for name, _ in outputs)
        declared = "Plane " + ", ".join(f"*{name}" for name, _ in outputs) + ";\n"
        nothing = ""
        if empty and all(names is not None for names in empty):
            asked = (
                " && ".join(sorted({f"{name}->zero" for names in empty for name in names or ()})) or "true"
            )
            nothing = (
                f"if ({asked}) {{ {' '.join(f'{name} = keep(c.nothing);' for name, _ in outputs)} }} else "
            )
        stores = "\n".join(
            f"{{ const V o = {value}; {name}->data[i] = o; a{name} |= o; }}" for name, value in outputs
        )
        ends = " ".join(f"{name}->zero = !any(a{name});" for name, _ in outputs)
        body = "\n".join(loop.lines)
        self.block.statements.append(
            f"{declared}{nothing}{{\n{takes}\n"
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
        kept = [unchanged(node) for node in nodes]
        if all(kept) and all(self.have(base) for base, _ in kept):  # type: ignore[misc]
            self.changed_rows(outputs, kept, lanes)  # type: ignore[arg-type]
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

    def settled(self, nodes: list[Node]) -> None:
        """Settled slots under choices: nothing is computed where no choice holds anywhere."""
        kept = [(node, *found) for node in nodes if (found := unchanged(node)) and self.have(found[0])]
        masks = list({id(mask): mask for _, _, chosen in kept for mask in chosen}.values())
        if not masks:
            return
        self.ensure(masks)
        condition = " || ".join(f"!{self.planes[id(mask)]}->zero" for mask in masks)
        self.change([node for node, _, _ in kept], {id(node): self.fields[id(base)] for node, base, _ in kept}, condition)

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

    def finish(self) -> None:
        """Leave the outputs in the context's slots."""
        self.inputs([node for _, node in self.pass_.outputs])
        self.settled([node for _, node in self.pass_.outputs if node.type == REAL and not self.have(node)])
        self.ensure([node for _, node in self.pass_.outputs])
        lines = []
        for slot, node in self.pass_.outputs:
            if node.type == REAL:
                number = self.layout.reals[slot]
                lines.append(f"Field* r{number} = keep({self.fields[id(node)]});")
            else:
                number = self.layout.planes[slot]
                lines.append(f"Plane* s{number} = keep({self.planes[id(node)]});")
        for slot, node in self.pass_.outputs:
            kind, table, prefix = (
                ("real", self.layout.reals, "r") if node.type == REAL else ("slot", self.layout.planes, "s")
            )
            place = f"c.{kind}[{table[slot]}]"
            lines.append(f"if ({place}) give(c, {place}); {place} = {prefix}{table[slot]};")
        self.block.statements.append("\n".join(lines))


def _conjunctions(node: Node) -> Iterator[Node]:
    """A mask and all parts of it that must hold."""
    yield node
    if node.op == "and":
        for arg in node.args:
            yield from _conjunctions(arg)


def _conjuncts(node: Node, have) -> list[Node]:  # type: ignore[no-untyped-def]
    if node.op != "and" or have(node):
        return [node]
    return [part for arg in node.args for part in _conjuncts(arg, have)]
