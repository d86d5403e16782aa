"""One pass as C++: moment after moment, each skipped where its masks are empty; values live as long as they are needed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator

from powderdsl.ir.ops import REAL, Node, PassGraph, Step, walk
from powderdsl.targets.cpp.blocks import Block
from powderdsl.targets.cpp.loops import ANCHORS, DRAWS, Loop, is_clean, is_uniform, prerequisites, zero_with
from powderdsl.targets.cpp.moves import Movement, depends, move_calls, movements
from powderdsl.targets.cpp.presence import (
    Asked,
    asked_ids,
    asked_now,
    asked_word,
    element_nodes,
    element_planes,
    only_moves,
    there,
)
from powderdsl.targets.cpp.sweeps import unchanged
from powderdsl.targets.cpp.values import ValueWriter
from powderdsl.targets.layout import Layout


class PassWriter(ValueWriter):
    """Writes `static void pass_N(Context& c)`."""

    def __init__(self, pass_: PassGraph, number: int, layout: Layout):
        super().__init__(pass_, layout)
        self.number = number
        self.asked_ids = asked_ids(pass_, element_planes(layout))
        self.asked = asked_word(self.asked_ids)
        """All ids that the pass asks for."""
        asked = Counter(
            key
            for step in pass_.moments
            for guard in dict.fromkeys(step.guards)
            for key in dict.fromkeys(id(part) for part in _conjunctions(guard))
        )
        self.shared = {key for key, count in asked.items() if count > 1}
        """Parts of several masks: where such a plane is empty, all of them are."""

    def source(self) -> str:
        current: dict[str, Node] = {}
        self.borrow()
        for step in self.pass_.moments:
            self.moment(step, current)
            current.update(step.writes)
        self.finish()
        body = self.block.text()
        skip = "" if self.asked_ids is None else f"if (!({there(self.asked_ids)})) return;\n"
        return f"// pass {self.number}\nOUTLINE void pass_{self.number}(Context& c) {{\n{skip}const int words = c.g.words, height = c.g.height, width = c.g.width, strips = c.g.strips ? -1 : 0; (void)words; (void)height; (void)width; (void)strips;\n{body}\n}}"

    def borrow(self) -> None:
        """Slots that the pass both reads and writes: nobody else holds them while it runs."""
        written = {slot for slot, _ in self.pass_.outputs}
        for key, node in self.input_nodes.items():
            if self.slot_of[key] not in written:
                continue
            if node.type == REAL:
                self.fields[key] = name = self.fresh("f")
                place = f"c.real[{self.layout.reals[self.slot_of[key]]}]"
                self.block.statements.append(f"Field* {name} = {place}; {place} = nullptr;")
            else:
                self.planes[key] = name = self.fresh("p")
                place = f"c.slot[{self.layout.planes[self.slot_of[key]]}]"
                self.block.statements.append(f"Plane* {name} = {place}; {place} = nullptr;")

    # Moments

    def moment(self, step: Step, current: dict[str, Node]) -> None:
        writes = [
            (slot, node)
            for slot, node in step.writes
            if id(node) in self.alive and node.type != REAL and not self.have(node)
        ]
        guards = [guard for guard in step.guards if guard.op != "const"]
        moves_only = only_moves(step, {slot: self.before(slot, current) for slot, _ in step.writes})
        if not moves_only and any(self.have(node) for _, node in step.writes):
            self.anything()
        if not writes:
            return
        self.comparisons(guards)
        guarded = len(guards) == len(step.guards) > 0 and not any(is_uniform(guard) for guard in guards)
        condition = ""
        if guarded:
            self.inputs(guards)
            now = {slot: self.before(slot, current) for slot in self.layout.planes}
            asked = asked_now(guards, element_planes(self.layout), element_nodes(now))
            self.asked |= asked_word(asked)
            condition = self.guards(guards, asked)
        if not moves_only:
            self.anything(f"if ({condition}) " if guarded else "")
        unknown = [node for slot, node in writes if slot not in current and slot not in self.layout.planes]
        if unknown or not guarded:  # a scratch field's first write: what it held is not in a plane
            wanted = unknown if guarded else [node for _, node in writes]
            self.inputs(wanted)
            self.ensure(wanted)
        writes = [(slot, node) for slot, node in writes if not self.have(node)]
        if not writes:
            return
        self.inputs([node for _, node in writes])
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

    def anything(self, condition: str = "") -> None:
        """From here on any element may be there, until the next step looks."""
        self.block.statements.append(f"{condition}c.present = ~0ull;")

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
        self.block.statements.append(
            " ".join(f"Plane* {name} = keep({olds[key]});" for key, name in names.items())
        )
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

    def guards(self, guards: list[Node], asked: Asked | None = None) -> str:
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
        whole = {}
        for guard, cheap, rest in staged:
            parts = [loop.value(part) for part in cheap]
            known = [found for part in cheap if (found := zero_with(part, self.planes)) is not None]
            empty.append(min(known, key=len, default=None))
            name = candidates[id(guard)] if rest else self.fresh("p")
            if not rest:
                whole[id(guard)] = name
            clean = any(is_clean(part, self.have) for part in cheap)
            outputs.append((name, " & ".join(parts) if clean else " & ".join([*parts, "valid"])))
        self.emit_loop(loop, outputs, empty, f"!({there(asked)})" if asked is not None else "")
        self.planes.update(whole)  # not before: until the loop has run, their planes hold nothing
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
        nothing = []
        loop = Loop(self.planes, self.layout)
        for guard, rest in rest_guards:
            candidate = candidates[id(guard)]
            nothing.append(empty_condition(candidate, rest, self.planes))
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
        without = " ".join(f"{name} = keep(c.nothing);" for name in names.values())
        self.block.statements.append(
            f"if ({' && '.join(nothing)}) {{ {without} }} else {{\n"
            f"{loop.ready()}\n{takes}\nfor (int y = 0, i = 0; y < height; y++) for (int w = 0; w < words; w++, i++) {{ const V valid = c.valid(w); (void)valid;\n"
            + "\n".join(lines) + f"\n}}\n{ends}\n}}"
        )  # fmt: skip
        text = self.block.text()
        self.planes, self.fields, self.block = outer
        declared = ", ".join(f"*{name}" for name in names.values())
        self.block.statements.append(
            f"Plane {declared};\nif ({condition}) {{\n{text}\n}} else {{ {without} }}"
        )
        self.planes.update(names)
        return " || ".join(f"!{self.planes[id(g)]}->zero" for g in guards)

    def shared_parts(self, guard: Node) -> list[Node]:
        """The largest parts of a mask that other masks have too, if one loop can compute them."""
        if self.have(guard) or guard.op in ("input", "not"):
            return []
        in_one_loop = not is_uniform(guard) and not prerequisites(guard, self.have)
        if (
            id(guard) in self.shared
            and in_one_loop
            and not any(inner.op in (*DRAWS, *ANCHORS) for inner in walk(guard))
        ):
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

    # The end

    def settled(self, nodes: list[Node]) -> None:
        """Settled slots under choices: nothing is computed where no choice holds anywhere."""
        kept = [(node, *found) for node in nodes if (found := unchanged(node)) and self.have(found[0])]
        masks = list({id(mask): mask for _, _, chosen in kept for mask in chosen}.values())
        if not masks:
            return
        self.ensure(masks)
        condition = " || ".join(f"!{self.planes[id(mask)]}->zero" for mask in masks)
        self.change(
            [node for node, _, _ in kept],
            {id(node): self.fields[id(base)] for node, base, _ in kept},
            condition,
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


def empty_condition(candidate: str, parts: list[Node], planes: dict[int, str]) -> str:
    """When a mask is surely empty: its candidates are, or all planes that one of its other parts hangs on."""
    reasons = [f"{candidate}->zero"]
    for part in parts:
        names = zero_with(part, planes)
        if names is not None:
            reasons.append(" && ".join(f"{name}->zero" for name in sorted(names)) or "true")
    return "(" + " || ".join(f"({reason})" for reason in dict.fromkeys(reasons)) + ")"


def _conjunctions(node: Node) -> Iterator[Node]:
    """A mask and all parts of it that must hold."""
    yield node
    if node.op == "and":
        for arg in node.args:
            yield from _conjunctions(arg)


def _conjuncts(node: Node, have: Callable[[Node], bool]) -> list[Node]:
    if node.op != "and" or have(node):
        return [node]
    return [part for arg in node.args for part in _conjuncts(arg, have)]
