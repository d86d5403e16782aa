"""Claims that hold by induction: each pass of a step preserves them, from any well-formed world."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import chain

from powderdsl.compiler import lower
from powderdsl.ir.bits import lower_pass
from powderdsl.ir.lower import lower_values
from powderdsl.ir.ops import REAL, Node, Offset, PassGraph, Program, needed, nodes_of
from powderdsl.model.state import slots
from powderdsl.model.types import Bounded, Claim, Local, Never, Ruleset, Symmetric, Total, Unchanging
from powderdsl.prover.net import FALSE, Literal
from powderdsl.prover.questions import Model, Questions
from powderdsl.prover.solver import OutOfWork
from powderdsl.prover.symbolic import (
    MAX_SIZE,
    Before,
    Budget,
    Cell,
    Formulas,
    Ranges,
    Renaming,
    Symbols,
    Turned,
    Undecided,
    World,
    reset,
)

HERE: Cell = (0, 0)

MAX_WHOLE = 40_000
"""Maximum number of gates and terms of a pass that is examined as a whole."""

ARRIVING = [(0, -1), (1, -1), (2, 0)]
READS = {"shift": [(0, 1)], "swap": [*ARRIVING, (0, 1), (1, 0)], "arrive": ARRIVING}
"""The cells in which a node reads its arguments: at its offset (1), opposite to it (-1) or here (0)."""

Check = Callable[["Transition"], bool]
Law = Callable[["Transition", World, Cell], Literal]
"""Returns a literal that is true if a claim holds at a cell of a world of a transition."""
Laws = Sequence[Law]


@dataclass(eq=False)
class Transition:
    """A pass, a substep or the start of a step: the worlds before and after it, and questions about them."""

    name: str
    symbols: Symbols
    starts: tuple[World, ...]
    """Well-formed worlds; laws are known to hold in the last one."""
    before: World
    after: World
    ranges: Ranges = field(default_factory=dict)
    formulas: Formulas | None = None
    moves: tuple[tuple[Node, Offset], ...] = ()
    """Flags of cells that exchange something with a neighbor, and the offset of that neighbor."""
    only_moves: bool | None = None
    """True if the transition only exchanges elements between cells; None if that is unknown."""
    model: Model | None = None
    """The answer to the last question, if any."""
    _facts: dict[object, list[Literal]] = field(default_factory=dict)
    _formulas: dict[int, Formulas] = field(default_factory=dict)

    @cached_property
    def questions(self) -> Questions:
        return Questions(self.symbols)

    def condition(self, node: Node, world: World, cell: Cell) -> Literal:
        """A condition at a cell of a world."""
        formulas = self._formulas.setdefault(id(world), Formulas(world, self.symbols))
        return formulas.value(node, *cell)

    def keeps(self, law: Law, given: Laws = ()) -> bool:
        """Return whether the law holds in a cell afterwards if it held in all cells before. Raises OutOfWork,
        Undecided."""
        broken = law(self, self.after, HERE) ^ 1
        return broken in (FALSE, law(self, self.before, HERE) ^ 1) or not self.can_be([broken], [law, *given])

    def can_be(self, literals: Sequence[Literal], laws: Iterable[Law] = ()) -> bool:
        """Return whether literals can be true at once, in well-formed worlds where some laws hold in all cells.

        Raises OutOfWork and Undecided.
        """
        if FALSE in literals:
            return False
        net, symbols = self.symbols.net, self.symbols
        cone = net.cone(literals)
        cells = symbols.cells_read(cone)
        given = [law(self, self.starts[-1], cell) for law in laws for cell in {HERE: None, **cells}]
        facts = [fact for cell, planes in cells.items() for fact in self._well_formed(cell, planes)]
        concerned = dict.fromkeys([*cone, *net.cone([*given, *facts, *symbols.general])])
        answer = self.questions.ask([*literals, *given], [*concerned])
        self.model = self.questions.model([*concerned]) if answer else None
        return answer

    def _well_formed(self, cell: Cell, planes: Iterable[str]) -> list[Literal]:
        """Require that a cell of the starts is well-formed, in some planes; return the facts."""
        key = (cell, *planes)
        if key not in self._facts:
            facts = [
                fact
                for world in self.starts
                for fact in self.symbols.well_formed(world, cell, planes, self.ranges)
            ]
            self._facts[key] = facts
            self.symbols.facts += facts
        return self._facts[key]


def growing_ranges(program: Program) -> list[Ranges]:
    """Before each pass and after the last: the ranges of the slots that start each step at their defaults."""
    ranges = {
        s.name: (int(s.default), int(s.default)) for s in program.slots if s.resets and s.type.name == "int"
    }
    before: list[Ranges] = [dict(ranges)]
    for pass_ in program.passes:
        for name, node in chain(pass_.outputs, *(step.writes for step in pass_.substeps)):
            if name in ranges:
                ranges[name] = (min(ranges[name][0], node.type.lo), max(ranges[name][1], node.type.hi))
        before.append(dict(ranges))
    return before


class Prover:
    """Proves claims about one ruleset, with one budget for all. Raises NotBits if bit planes cannot express a pass."""

    def __init__(self, ruleset: Ruleset, budget: Budget) -> None:
        self.ruleset, self.budget = ruleset, budget
        self.program = lower(ruleset)
        self.planes = [lower_pass(self.program, pass_) for pass_ in self.program.passes]
        self.ranges = growing_ranges(self.program)
        self._transitions: dict[tuple[int, bool], list[Transition]] = {}
        self._laws: dict[frozenset[int], Law] = {}
        self._failures: list[int] = []
        """Passes in which sums could not be proven."""

    def _symbols(self, limit: int = MAX_SIZE) -> Symbols:
        return Symbols(self.ruleset, self.program, self.budget, limit)

    @cached_property
    def start(self) -> Transition:
        """The start of a step, where slots are reset."""
        before = Before(symbols := self._symbols())
        return Transition("start", symbols, (before,), before, reset(before, symbols))

    def broken_by(self, check: Check, *, everywhere: bool = False) -> Transition | None:
        """The first transition of a step that fails a check. Unless the check must hold `everywhere`, it may hold for a
        whole pass."""
        if not check(self.start):
            return self.start
        for number, pass_ in enumerate(self.planes):
            places = range(len(pass_.substeps))
            failed = next((m for place in places if (m := self._failed(number, place, check))), None)
            if failed is None:
                continue
            whole = failed if everywhere or len(places) == 1 else self.transitions(number, cut=False)[-1]
            try:
                if whole is failed or not check(whole):
                    return whole
            except (Undecided, OutOfWork):
                return failed
        return None

    def _failed(self, number: int, place: int, check: Check) -> Transition | None:
        """None if a substep passes a check: from any well-formed world, or from the results of the substeps before it."""
        failed = None
        for cut in (True, False) if place else (False,):
            transition = self.transitions(number, cut=cut)[place]
            try:
                if check(transition):
                    return None
                failed = transition
            except (Undecided, OutOfWork):
                if failed is None:
                    raise
        return failed

    def transitions(self, number: int, *, cut: bool) -> list[Transition]:
        """The substeps of a pass, from any well-formed world if `cut`; otherwise from the results of earlier ones,
        followed by the pass as a whole."""
        if (number, cut) in self._transitions:
            return self._transitions[number, cut]
        transitions = []
        pass_, ranges = self.planes[number], self.ranges[number + cut]
        state, known = dict[str, Node](), dict[Node, tuple[str, str]]()
        row = self.start.symbols.layouts["element"]
        formulas = Formulas(begin := Before(symbols := self._symbols(MAX_WHOLE)), symbols)
        for place, substep in enumerate(pass_.substeps):
            elements = [(plane, node) for plane, node in substep.writes if plane in row.planes]
            moves = tuple(_moves(elements, known))
            if cut:
                begin = Before(symbols := self._symbols(MAX_WHOLE))
                formulas = Formulas(begin, symbols)
                formulas.cut = dict(known)
            before = formulas.after(state.items())
            state |= dict(substep.writes)
            ends = pass_.outputs if place == len(pass_.substeps) - 1 else ()
            after = formulas.after([*state.items(), *ends])
            starts = (begin, before) if cut else (begin,)
            name = f"{pass_.name}.{place}" if len(pass_.substeps) > 1 else pass_.name
            transitions.append(Transition(name, symbols, starts, before, after, ranges, formulas, moves))
            for plane, node in substep.writes:
                if node.op not in ("input", "const"):
                    known.setdefault(node, (f"{place}", plane))
        whole = Transition(pass_.name, symbols, (begin,), begin, transitions[-1].after, ranges)
        return self._transitions.setdefault((number, cut), transitions if cut else [*transitions, whole])

    def broken(self, claim: Claim, without: frozenset[int] = frozenset()) -> Transition | None:
        """Return None if the claim is proven for worlds that start without some elements; else a transition that may
        break it, with a model of how. Raises OutOfWork and Undecided."""
        given = [self.reachable(without)] if without else []
        passes = range(len(self.planes))
        match claim:
            case Unchanging():
                return self.broken_by(partial(self._unchanging, claim.ids, given))
            case Total(ids=frozenset() as ids):
                for number in sorted(
                    passes, key=self._failures.count, reverse=True
                ):  # passes that failed before come first
                    if transition := self._counted(number, ids, claim.trend, given):
                        self._failures.append(number)
                        return transition
                return None
            case Symmetric():
                turned = (self._symmetric(number, claim.turn) for number in passes)
                return next((transition for transition in turned if transition), None)
            case Never(steps=1) | Bounded():
                law = self._law(claim)
                return self.broken_by(lambda transition: transition.keeps(law, given))
            case Never():
                return self._never_for(claim, given)
            case Local() if self._reach() <= claim.radius:
                return None
        raise Undecided("this kind of claim")

    def _condition(self, claim: Never) -> Node:
        """The condition of a claim on bit planes."""
        graph = lower_pass(self.program, lower_values(self.ruleset, {"condition": claim.condition}))
        if _reads_clock(graph):  # it changes from step to step, not from pass to pass
            raise Undecided("the clock")
        ((_, condition),) = graph.outputs
        return condition

    def _law(self, claim: Never | Bounded) -> Law:
        if isinstance(claim, Never):
            condition = self._condition(claim)
            return lambda transition, world, cell: transition.condition(condition, world, cell) ^ 1
        row = self.start.symbols.layouts.get(claim.field)
        if row is None:
            raise Undecided("bounds of floats")
        return lambda transition, world, cell: transition.symbols.net.within(
            row.bits(world, *cell), claim.lo, claim.hi, signed=row.signed
        )

    def reachable(self, gone: frozenset[int]) -> Law:
        """Return the law that limits the elements of cells and fields if worlds start without some."""
        if gone in self._laws:
            return self._laws[gone]
        rows = [row for row in self.start.symbols.layouts.values() if row.slot.kind.name == "element"]
        known = set(self.start.symbols.ids) - gone
        # A field's usual element, absent or not, is in fresh cells and in cells that can contain no other.
        allowed = {row.slot.name: known | {row.usual[i] or 0 for i in known} for row in rows}

        def law(transition: Transition, world: World, cell: Cell) -> Literal:
            net = transition.symbols.net
            return net.all(net.member(row.bits(world, *cell), allowed[row.slot.name]) for row in rows)

        # Elements that a transition adds are allowed from now on.
        while transition := self.broken_by(lambda transition: transition.keeps(law), everywhere=True):
            for row in rows:
                bits = map(transition.questions.holds, row.bits(transition.after, *HERE))
                allowed[row.slot.name].add(sum(bit << i for i, bit in enumerate(bits)))
        return self._laws.setdefault(gone, law)

    def _never_for(self, claim: Never, given: Laws) -> Transition | None:
        """Return whether a condition can hold in a cell for several successive steps."""
        if claim.steps > 2 and any(map(_reads_clock, self.planes)):
            raise Undecided("the clock")
        symbols, condition = self._symbols(), self._condition(claim)
        start: World = Before(symbols)
        transition = Transition("steps", symbols, (start,), start, start)
        world, holds = start, [transition.condition(condition, start, HERE)]
        for step in range(claim.steps - 1):
            names = Renaming(
                streams={s.name: f"{s.name} {step}" for s in self.ruleset.streams}
            )  # each step draws new numbers
            world = reset(world, symbols)
            for pass_ in self.planes:
                world = Formulas(world, symbols, names).after(pass_.outputs)
            holds.append(transition.condition(condition, world, HERE))
        return transition if transition.can_be(holds, given) else None

    def well_formed(self) -> Transition | None:
        """The first pass or substep that may leave a cell that is not well-formed; None if there is none."""

        def keeps(transition: Transition) -> bool:
            worlds = transition.after, transition.before
            after, before = (transition.symbols.well_formed(world, HERE) for world in worlds)
            facts = (fact for fact, same in zip(after, before, strict=True) if fact != same)
            return not transition.can_be([transition.symbols.net.all(facts) ^ 1])

        return self.broken_by(keeps, everywhere=True)

    def _unchanging(self, ids: frozenset[int], given: Laws, transition: Transition) -> bool:
        net, row = transition.symbols.net, transition.symbols.layouts["element"]
        before, after = (row.bits(world, *HERE) for world in (transition.before, transition.after))
        changed = net.any(map(net.xor, before, after))
        return not transition.can_be([net.member(before, ids), changed], given)

    def _counted(self, number: int, ids: frozenset[int], trend: str, given: Laws) -> Transition | None:
        """The first substep of a pass that may change the number of cells with some elements against a trend."""
        planes = self.start.symbols.layouts["element"].planes
        changing = [
            i for i, s in enumerate(self.planes[number].substeps) if any(p in planes for p, _ in s.writes)
        ]

        def keeps(transition: Transition) -> bool:
            return self._only_moves(transition) or self._matched(transition, ids, trend, given)

        return next((transition for i in changing if (transition := self._failed(number, i, keeps))), None)

    def _only_moves(self, transition: Transition) -> bool:
        """Return whether a substep only exchanges elements between cells, which changes no number."""
        if transition.only_moves is not None:
            return transition.only_moves
        net, row = transition.symbols.net, transition.symbols.layouts["element"]

        def differ(world: World, cell: Cell, other: World, place: Cell) -> Literal:
            return net.any(map(net.xor, row.bits(world, *cell), row.bits(other, *place)))

        def breaks(cells: Sequence[Cell]) -> Literal:
            pairs = zip(cells, reversed(cells), strict=True)
            return net.any(differ(transition.after, cell, transition.before, other) for cell, other in pairs)

        transition.only_moves = not self._can_break(
            transition, lambda a, b: differ(transition.before, a, transition.before, b), breaks, ()
        )
        return transition.only_moves

    def _matched(self, transition: Transition, ids: frozenset[int], trend: str, given: Laws) -> bool:
        """Return whether the number of cells with some elements follows a trend in a substep."""
        net, row = transition.symbols.net, transition.symbols.layouts["element"]

        def counted(world: World, cell: Cell) -> Literal:
            return net.member(row.bits(world, *cell), ids)

        def breaks(cells: Sequence[Cell]) -> Literal:
            """Return whether the number of counted cells, of one or two, changes against the trend."""
            sums = []
            for world in (transition.before, transition.after):
                flags = [counted(world, cell) for cell in cells]
                sums.append((net.any(flags), net.all(flags)) if len(flags) > 1 else (flags[0], FALSE))
            more, fewer = (
                net.any(net.and_(b, a ^ 1) for a, b in zip(*pair, strict=True)) for pair in (sums, sums[::-1])
            )
            return {"constant": net.or_(more, fewer), "never rises": more, "never falls": fewer}[trend]

        def differ(cell: Cell, other: Cell) -> Literal:
            return net.xor(counted(transition.before, cell), counted(transition.before, other))

        return not self._can_break(transition, differ, breaks, given)

    def _can_break(
        self,
        transition: Transition,
        differ: Callable[[Cell, Cell], Literal],
        breaks: Callable[[Sequence[Cell]], Literal],
        given: Laws,
    ) -> bool:
        """Return whether a sum over all cells may change in a forbidden way, as far as matching cells can show.

        Moves match different cells in pairs; other cells stay single. If no cell belongs to two pairs, and no pair and no
        single cell breaks the rule, the sum does not break it.
        """
        net = transition.symbols.net
        assert transition.formulas is not None
        value, matched, broken = transition.formulas.value, list[Literal](), list[Literal]()
        for node, (dy, dx) in transition.moves:
            forth = net.and_(value(node, *HERE), differ(HERE, (dy, dx)))
            back = net.and_(value(node, -dy, -dx), differ((-dy, -dx), HERE))
            broken.append(net.and_(forth, breaks([HERE, (dy, dx)])))
            broken += [net.and_(other, event) for other in matched for event in (forth, back)]
            broken.append(net.and_(forth, back))
            matched += [forth, back]
        broken.append(net.and_(net.any(matched) ^ 1, breaks([HERE])))
        return transition.can_be([net.any(broken)], given)

    def _reach(self) -> int:
        """Return the distance, in rows or columns, of the cells on which a cell depends after a step."""
        total = 0
        for pass_ in self.planes:
            far: dict[Node, tuple[int, ...]] = {}  # by node: how far it reads up, down, left and right
            for node in nodes_of(pass_, substeps=False):
                dy, dx = node.attr[:2] if node.op in READS else (0, 0)
                boxes = [
                    [
                        way + sign * more
                        for way, more in zip(far[node.args[i]], (-dy, dy, -dx, dx), strict=True)
                    ]
                    for i, sign in READS.get(node.op, [(i, 0) for i in range(len(node.args))])
                ]
                far[node] = (*map(max, zip(*boxes, strict=True)),) or (0, 0, 0, 0)
            total += max((max(far[node]) for _, node in pass_.outputs), default=0)
        return total

    def _symmetric(self, number: int, turn: str) -> Transition | None:
        """Return None if a pass gives the turned world for a turned world and turned draws."""
        if any(slot.resets and slot.kind.name in ("direction", "vec2") for slot in slots(self.ruleset)):
            raise Undecided("directions that are reset are not rotated")
        before = Before(symbols := self._symbols())
        pass_, net = self.planes[number], symbols.net
        if any(node.type == REAL for _, node in pass_.outputs):
            raise Undecided("floats in rotated or mirrored worlds")
        turned = Turned(before, symbols, turn)
        plain = Turned(Formulas(before, symbols).after(pass_.outputs), symbols, turn)
        symbols.turn = turned.place
        of_turned = Formulas(turned, symbols).after(pass_.outputs)
        first = [of_turned.bit(plane, *HERE) for plane, _ in pass_.outputs]
        symbols.turn = None
        second = [plain.bit(plane, *HERE) for plane, _ in pass_.outputs]
        transition = Transition(pass_.name, symbols, (before,), before, plain, self.ranges[number])
        return transition if transition.can_be([net.any(map(net.xor, first, second))]) else None


def _reads_clock(pass_: PassGraph) -> bool:
    return any(node.op == "coordinate" and node.attr[0] == "step" for node in nodes_of(pass_))


def _moves(writes: Iterable[tuple[str, Node]], cut: Container[Node]) -> Iterator[tuple[Node, Offset]]:
    """The movers of a substep, and where they move; `cut` are nodes of substeps before."""

    def contents(node: Node) -> tuple[Node, ...]:
        if node in cut:
            return ()
        return (node.args[0], node.args[2]) if node.op in ("swap", "arrive") else node.args

    nodes = needed([node for _, node in writes], contents)
    moving = (node for node in nodes if node.op in ("swap", "arrive") and node not in cut)
    yield from dict.fromkeys((node.args[1], node.attr) for node in moving)
