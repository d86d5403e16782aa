"""One pass as a schedule: moment after moment, each skipped where its masks are empty."""

from __future__ import annotations

from dataclasses import replace

from powderdsl.ir.ops import REAL, Node, PassGraph, Step, nodes_of, walk
from powderdsl.targets.cpp.loops import DRAWS, is_uniform
from powderdsl.targets.cpp.sweeps import conjuncts, leading, quiet, stored_parts, sweep_needs, unchanged
from powderdsl.targets.cuda.cells import Cells, quiet_reads
from powderdsl.targets.cuda.schedule import CellOutput, CellPhase, Finish, Guarded, Statement, WordPhase, flat
from powderdsl.targets.cuda.words import REALS, WordLoop, Words, joined
from powderdsl.targets.layout import Layout


class PassSchedule:
    """The statements of a pass. `homes` are variables that the pass finds in slots' buffers."""

    def __init__(self, pass_: PassGraph, layout: Layout):
        self.pass_, self.layout = pass_, layout
        self.planes: dict[int, str] = {}
        self.fields: dict[int, str] = {}
        self.homes: dict[str, int] = {}
        self.slots: dict[str, str] = {}
        """Variables of the slots' first values."""
        self.prefers: dict[str, str] = {}
        self.named: dict[int, str] = {}
        """Names that nodes get once they are stored, where that was settled before."""
        self.statements: list[Statement] = []
        self.count = 0
        self.words = Words(pass_)
        nodes = list({id(n): n for _, root in pass_.outputs for n in walk(root)}.values())
        self.alive = {id(n) for n in nodes}
        self.all_comparisons = [n for n in nodes if n.op in REALS]
        sources = [n.args[0] for n in nodes if n.op == "shift" and n.type == REAL]
        self.stored = {
            id(part)
            for n in sources
            for part in stored_parts(n, lambda node: node.op == "input")
            if part.op != "input"
        }
        self.leaders = {
            id(n): leader for n in self.all_comparisons if (leader := leading(n, self.all_comparisons, pass_))
        }
        asked = [node for step in pass_.moments for guard in step.guards for node in walk(guard)]
        for node in [*nodes_of(pass_), *asked]:
            if node.op == "input":
                real = node.type == REAL
                (self.fields if real else self.planes)[id(node)] = self.slot(str(node.attr), real)
        current: dict[str, Node] = {}
        for step in pass_.moments:
            self.moment(step, current)
            current.update(step.writes)
        self.finish()

    # Variables

    def fresh(self, prefix: str) -> str:
        self.count += 1
        return f"{prefix}{self.count}"

    def new(self, node: Node) -> str:
        """The variable of a node that is about to be stored."""
        name = self.named.get(id(node)) or self.fresh("f" if node.type == REAL else "p")
        (self.fields if node.type == REAL else self.planes)[id(node)] = name
        return name

    def have(self, node: Node) -> bool:
        return id(node) in self.planes or id(node) in self.fields

    def slot(self, slot: str, real: bool) -> str:
        if slot not in self.slots:
            name = self.slots[slot] = self.fresh("f" if real else "p")
            self.homes[name] = (self.layout.reals if real else self.layout.planes)[slot]
        return self.slots[slot]

    # Moments

    def moment(self, step: Step, current: dict[str, Node]) -> None:
        guards = list({id(g): g for g in step.guards if g.op != "const"}.values())
        always = len(guards) < len({id(g) for g in step.guards}) or any(is_uniform(g) for g in guards)
        writes = self.writes(step)
        if not writes:
            return
        self.comparisons(guards)
        unknown = [node for slot, node in writes if slot not in current and slot not in self.layout.planes]
        self.ensure(unknown)  # a scratch field's first write: what it held is not in a plane
        writes = self.writes(step)
        if not writes:
            return
        nodes = [node for _, node in writes]
        olds = {id(node): self.old(slot, current.get(slot)) for slot, node in writes}
        if not guards or always:
            for node in nodes:
                self.named[id(node)] = name = self.fresh("p")
                self.prefers[name] = olds[id(node)]
            self.ensure(nodes)
            return
        outer, self.statements = self.statements, []
        scope = (dict(self.planes), dict(self.fields))
        stages = self.stages(guards)
        kept = [(g, "") for g in guards if id(g) not in scope[0] and id(g) not in olds]
        for node in nodes:
            if not self.have(node):
                self.named[id(node)] = self.fresh("p")
        self.ensure(nodes)
        kept += [(node, olds[id(node)]) for node in dict.fromkeys(nodes)]
        keeps = tuple((self.planes[id(node)], old) for node, old in kept)
        body, self.statements = tuple(self.statements), outer
        names = {id(node): self.planes[id(node)] for node, _ in kept}
        self.planes, self.fields = scope
        self.planes |= names
        self.statements.append(Guarded(stages, body, keeps))

    def writes(self, step: Step) -> list[tuple[str, Node]]:
        """What a moment leaves to compute: reals are computed when somebody asks."""
        return [
            (slot, node)
            for slot, node in step.writes
            if id(node) in self.alive and node.type != REAL and not self.have(node)
        ]

    def comparisons(self, guards: list[Node]) -> None:
        """Comparisons of reals that masks ask for, outside any branch, with all others that can be had in one loop."""
        asked = [n for guard in guards for n in walk(guard) if n.op in REALS and not self.have(n)]
        if not asked:
            return
        self.ensure([need for node in asked for need in self.needs(node)])
        others = [n for n in self.all_comparisons if not self.have(n) and n not in asked]
        self.ensure([*asked, *(n for n in others if not self.needs(n))])

    def old(self, slot: str, node: Node | None) -> str:
        """The plane that holds a slot's value before the moment; "" if nothing holds."""
        if node is None:
            return self.slot(slot, False)
        if not self.have(node):
            if node.op == "const" and not node.attr:
                return ""
            self.ensure([node])
        return self.planes[id(node)]

    def stages(self, guards: list[Node]) -> tuple[tuple[Statement, ...], ...]:
        """The masks of a moment: first what is cheap, and the rest only where that leaves something."""
        stages: list[tuple[Statement, ...]] = []
        split = {id(g): self.split(g) for g in guards if not self.have(g)}
        if any(self.needs(g) for g in guards if not self.have(g)):
            if all(cheap for cheap, _ in split.values()):
                loop = WordLoop(self.planes, self.layout)
                some = [
                    joined(loop, [loop.value(part) for part in split[id(g)][0]])
                    if id(g) in split
                    else loop.value(g)
                    for g in guards
                ]
                stages.append(
                    (WordPhase(tuple(loop.lines), (), dict(loop.reads), f"({' | '.join(some)}) != 0"),)
                )
            self.ensure([need for g in guards if not self.have(g) for need in self.needs(g)])
        before, self.statements = self.statements, []
        loop = WordLoop(self.planes, self.layout)
        open_guards = [g for g in guards if not self.have(g)]
        names = {id(g): f"g{number}" for number, g in enumerate(open_guards)}
        for guard in open_guards:
            self.mask(guard, *self.split(guard), loop, names[id(guard)])
            loop.memo[id(guard), 0, 0] = names[id(guard)]
        some = [names.get(id(g)) or loop.value(g) for g in guards]
        # Only now do they stand in planes: in this loop other words cannot be read yet.
        outputs = tuple((self.new(g), names[id(g)]) for g in open_guards)
        question = WordPhase(tuple(loop.lines), outputs, dict(loop.reads), f"({' | '.join(some)}) != 0")
        stages.append((*before, question))
        return tuple(stages)

    def split(self, guard: Node) -> tuple[list[Node], list[Node]]:
        """Conjuncts that one loop can compute from what is there, and those that take more."""
        cheap: list[Node] = []
        rest: list[Node] = []
        for part in conjuncts(guard):
            draws = any(n.op in DRAWS for n in walk(part)) and not self.have(part)
            (
                rest if draws or (part.op in REALS and not self.have(part)) or self.needs(part) else cheap
            ).append(part)
        return cheap, rest

    def mask(self, guard: Node, cheap: list[Node], rest: list[Node], loop: WordLoop, name: str) -> None:
        """Statements for a mask's word: candidates first, draws only for words that have some."""
        loop.lines.append(f"u32 {name} = {' & '.join(['valid', *(loop.value(part) for part in cheap)])};")
        if not rest:
            return
        inner = loop.inner()
        value = name
        for part in sorted(rest, key=lambda part: part.op in DRAWS):
            if part.op in DRAWS and not inner.have(part):
                value = inner.name(inner.draw(part, value))
            else:
                value = inner.name(f"{value} & {inner.value(part)}")
        loop.lines.append("\n".join([f"if ({name}) {{", *inner.lines, f"{name} = {value};", "}"]))

    # Values

    def needs(self, node: Node) -> list[Node]:
        """What must be stored before a node can be computed."""
        if node.type == REAL or node.op in REALS:
            flags, reals = sweep_needs(node, self.have)
            return [*flags, *reals]
        return self.words.needs(node, self.have)

    def ensure(self, nodes: list[Node]) -> None:
        """Store nodes, and before them everything they need."""
        wanted = [
            node
            for node in dict.fromkeys(nodes)
            if not self.have(node) and not (is_uniform(node) and node.type == REAL)
        ]
        if not wanted:
            return
        before = [
            n for n in dict.fromkeys(need for node in wanted for need in self.needs(node)) if not self.have(n)
        ]
        if before:
            self.ensure(before)
            self.ensure(wanted)
            return
        reals = [n for n in wanted if n.type == REAL or n.op in REALS]
        # What neighbours will be asked for later is stored while it is computed anyway.
        reals += [i for n in reals for i in walk(n) if id(i) in self.stored and not self.have(i)]
        reals = list(dict.fromkeys(reals))
        flags = [n for n in wanted if n not in reals]
        if reals:
            self.sweep(reals)
        if flags:
            loop = WordLoop(self.planes, self.layout)
            values = [loop.clean(node) for node in flags]
            outputs = tuple((self.new(node), value) for node, value in zip(flags, values, strict=True))
            self.statements.append(WordPhase(tuple(loop.lines), outputs, dict(loop.reads)))

    def sweep(self, nodes: list[Node]) -> None:
        """Compute reals and comparisons cell by cell, in the words where something is going on."""
        # A comparison that others are asked only together with comes before them.
        leaders = {id(leader) for leader in self.leaders.values()}
        nodes = sorted(nodes, key=lambda n: (n.type != REAL, id(n) not in leaders))
        values, masks, _ = quiet(nodes, self.have)
        kept = [unchanged(node) for node in nodes]
        cells = Cells(self.planes, self.fields, self.layout)
        cells.wanted = [
            n
            for n in dict.fromkeys(i for node in nodes if node.type == REAL for i in walk(node))
            if n.op == "select" and n.type == REAL
        ]
        found = [
            cells.value(node) if node.type == REAL else cells.comparison(node, self.leaders) for node in nodes
        ]
        olds = ["" for _ in nodes]
        busy, asked = "", ""
        if all(kept) and all(one and self.have(one[0]) for one in kept):
            olds = [self.fields[id(one[0])] for one in kept if one]
            masks = [mask for one in kept if one for mask in one[1]]
            asked = " | ".join(dict.fromkeys(f"{self.planes[id(m)]}[i]" for m in masks)) or "0"
            busy = f"({asked}) != 0"
        elif values is not None and not any(m.op == "param" for m in masks):
            reads = quiet_reads(nodes, self.have)
            lives = [f"n{self.fields[id(node)][1:]}" for node, _, _ in reads]
            words = [f"{self.planes[id(m)]}[i]" for m in masks]
            near = [f"near({n}, l, y, w, {dy}, {dx})" for n, (_, dy, dx) in zip(lives, reads, strict=True)]
            asked = " | ".join(dict.fromkeys([*(f"{n}[i]" for n in lives), *words])) or "0"
            busy = f"({' | '.join(dict.fromkeys([*words, *near])) or '0'}) != 0"
        outputs = []
        reads_all = dict(cells.reads)
        for position, (node, value, old) in enumerate(zip(nodes, found, olds, strict=True)):
            rest = bool(values[position]) if values is not None else False
            outputs.append(CellOutput(self.new(node), value, "valid" if rest else "0", old))
        for mask in masks:
            if mask.op != "param":
                reads_all.setdefault(self.planes[id(mask)], False)
        lines = [f"const u32 {name} = {plane}[i];" for plane, name in cells.words.items()]
        self.statements.append(
            CellPhase(tuple(lines), tuple(cells.lines), tuple(outputs), reads_all, busy, asked)
        )

    def finish(self) -> None:
        """Leave the outputs in the slots' buffers."""
        self.ensure([node for _, node in self.pass_.outputs])
        pairs = []
        for slot, node in self.pass_.outputs:
            if node.type == REAL:
                pairs.append((self.fields[id(node)], self.layout.reals[slot]))
            else:
                pairs.append((self.planes[id(node)], self.layout.planes[slot]))
        self.statements.append(Finish(tuple(pairs)))
        self.statements = without_unread(self.statements)

    @property
    def open_homes(self) -> frozenset[tuple[str, int]]:
        """Buffers of all slots that the pass leaves changed."""
        tables = {"p": self.layout.planes, "f": self.layout.reals}
        kinds = [("f" if node.type == REAL else "p", slot) for slot, node in self.pass_.outputs]
        return frozenset((kind, tables[kind][slot]) for kind, slot in kinds)

    @property
    def changed(self) -> frozenset[str]:
        """Variables of slots that the pass leaves changed."""
        outputs = {slot for slot, _ in self.pass_.outputs}
        return frozenset(name for slot, name in self.slots.items() if slot in outputs)


def without_unread(statements: list[Statement]) -> list[Statement]:
    """The same without fields that were stored for neighbours who then did not ask."""
    read = {name for s in flat(statements) if isinstance(s, WordPhase | CellPhase) for name in s.reads}
    read |= {name for s in flat(statements) if isinstance(s, Finish) for name, _ in s.pairs}
    read |= {old for s in flat(statements) if isinstance(s, Guarded) for _, old in s.keeps}
    read |= {o.keeps for s in flat(statements) if isinstance(s, CellPhase) for o in s.outputs}

    def kept(statement: Statement) -> Statement:
        if not isinstance(statement, CellPhase):
            return statement
        return replace(statement, outputs=tuple(o for o in statement.outputs if o.name in read))

    return [s for s in map(kept, statements) if not isinstance(s, CellPhase) or s.outputs]
