"""The common part of the printers of C++, CUDA and WebAssembly: a method for each kind of statement, and named values."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Generic, TypeVar

from powderdsl.ir.ops import Node, needed, ordered
from powderdsl.ir.text import infix
from powderdsl.schedule.costs import DRAWS
from powderdsl.schedule.types import Compute, Out, Statement
from powderdsl.schedule.words import is_whole

Named = TypeVar("Named")
"""The type that stands for a value in the text of a target: its name, or its code."""


class Printer:
    """Prints each statement by the method that is named after its class."""

    whole: Callable[[Out], Any]
    words: Callable[[Compute], Any]
    update: Callable[[Compute], Any]

    def block(self, body: Sequence[Statement]) -> Any:
        for statement in body:
            yield from getattr(self, type(statement).__name__.lower())(statement)

    def compute(self, loop: Compute) -> Any:
        """A loop over words: an operation on whole planes, newly computed planes, or an update where a mask holds."""
        if len(loop.outs) == 1 and loop.over == "words" and is_whole(loop.outs[0].value):
            return self.whole(loop.outs[0])
        return self.words(loop) if loop.region is None else self.update(loop)


class Values(Generic[Named]):
    """Statements of a block, and the names of their results: by the id of a value's node, or by a key."""

    direct: tuple[str, ...] = ("shift",)
    """Operations that are printed without names for their arguments; of a `when`, only the first argument needs a name."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.known: dict[object, Named] = {}
        self.count = 0

    def node(self, node: Node, args: Sequence[Named]) -> Named:
        """The name or expression of a node, from the names of the arguments in `below`."""
        raise NotImplementedError

    def named(self, node: Node, value: Named) -> Named:
        """A node's expression, or a name for it."""
        return value

    def of(self, root: Node) -> Named:
        """The name of a value."""
        for node, below in needed([root], self.below).items():
            if id(node) not in self.known:
                args = [self.known[id(arg)] for arg in below]
                self.known[id(node)] = self.named(node, self.node(node, args))
        return self.known[id(root)]

    def below(self, node: Node) -> Sequence[Node]:
        """The arguments that get names before a node does."""
        if id(node) in self.known or node.op in self.direct:
            return ()
        return node.args[:1] if node.op == "when" else node.args

    def fresh(self, prefix: str) -> str:
        self.count += 1
        return f"{prefix}{self.count}"

    @contextmanager
    def inner(self, more: Mapping[object, Named] | None = None) -> Iterator[list[str]]:
        """A nested block: its lines, and names that are valid only inside, such as `more`."""
        outer, known = self.lines, self.known
        self.lines, self.known = [], {**known, **(more or {})}
        yield self.lines
        self.lines, self.known = outer, known


GATES = infix("and or xor") | {"not": "~{0}", "select": "mux({0}, {1}, {2})"}
"""The expression of each gate in C++ and CUDA, with the arguments by number."""

FLOATS = infix("add sub mul") | {
    "div": "divide({0}, {1})",
    "neg": "-{0}",
    "min": "smaller({0}, {1})",
    "max": "larger({0}, {1})",
}
"""The expressions of operations on floats that are the same in C++ and CUDA."""


class WordText(Values[str]):
    """Flags as text, one word at a time. `type` is the type of a word."""

    type: str

    def named(self, node: Node, value: str) -> str:
        if value.isidentifier():
            return value
        name = self.fresh("t")
        self.lines.append(f"const {self.type} {name} = {value};")
        return name


def limited_draw(node: Node) -> Node | None:
    """The draw that a conjunction equals, since the draw is only made where the other flag holds."""
    for value, draw in (node.args, node.args[::-1]) if node.op == "and" else ():
        if draw.op in DRAWS and draw.args[-1:] == (value,):
            return draw
    return None


def drawn_where(draw: Node) -> Node | None:
    """The flag where the result of a draw matters."""
    args = draw.args[draw.attr[1] + 1 :] if draw.op == "below_planes" else draw.args
    return args[0] if args else None


MAX_PRINTED = 1000
"""Maximum number of repeated choices; beyond it, each is computed once, before those that need it, in all cells."""


class CellValues(Values[Named]):
    """Floats, and flags that compare them: the values `nodes` of a loop."""

    direct: tuple[str, ...] = ("select", "led", "shift")

    def __init__(self, nodes: Iterable[Node]) -> None:
        super().__init__()
        self.nodes = [*nodes]
        if _printed_choices(self.nodes) > MAX_PRINTED:
            self.direct = ("led", "shift")

    def below(self, node: Node) -> Sequence[Node]:
        args = super().below(node)
        return args[1:] if node.op == "select" else args  # the plane of a mask has no name

    def variable(self, value: Named) -> Named:
        """A new variable, which choices change."""
        raise NotImplementedError

    def chosen(self, mask: Node, variables: Sequence[Named], values: Sequence[Node]) -> None:
        """Set variables to other values where a mask holds; values are computed only if the mask holds in some cell."""
        raise NotImplementedError

    def choice(self, node: Node) -> Named:
        """The name of a chain of choices. Chains on the same masks get names too: the components of a vector share tests."""
        chains = self.alike(node)
        variables = [self.variable(self.of(chain[-1].args[2])) for chain in chains]
        for choices in reversed(list(zip(*chains, strict=True))):
            known = self.known
            olds = {id(choice.args[2]): name for choice, name in zip(choices, variables, strict=True)}
            self.known = known | olds  # valid only here, since the variables change
            self.chosen(choices[0].args[0], variables, [choice.args[1] for choice in choices])
            self.known = known
        self.known |= {id(chain[0]): name for chain, name in zip(chains, variables, strict=True)}
        return variables[0]

    def led_by(self, leader: Node) -> list[Node]:
        """The comparisons that are computed only where a flag, their leader, holds."""
        return [node for node in self.nodes if node.op == "led" and node.args[0] is leader]

    def chain(self, node: Node) -> list[Node]:
        """A choice and the choices below it in third arguments, outermost first."""
        chain: list[Node] = []
        while node.op == "select" and id(node) not in self.known:
            chain.append(node)
            node = node.args[2]
        return chain

    def alike(self, node: Node) -> list[list[Node]]:
        """The chain of a choice, and others on the same masks. None of them depends on another."""
        chains = [self.chain(node)]
        masks = [choice.args[0] for choice in chains[0]]
        for other in self.nodes:
            chain = [] if other is node else self.chain(other)
            same = len(chain) > 1 and [choice.args[0] for choice in chain] == masks
            if same and not any(_depends(other, c[0]) or _depends(c[0], other) for c in chains):
                chains.append(chain)
        return chains


def _printed_choices(nodes: Iterable[Node]) -> int:
    """The number of repeated choices in the text of a loop.

    A choice computes nested choices only where its mask holds, so they are printed again for every other user.
    """
    below: dict[Node, frozenset[Node]] = {}
    size: dict[Node, int] = {}
    for node in nodes:
        nearest = frozenset[Node]().union(*(below[arg] for arg in node.args))
        below[node] = nearest
        if node.op == "select":
            size[node] = 1 + sum(size[choice] for choice in nearest)
            below[node] = frozenset((node,))
    return max(size.values(), default=0) - len(size)


def _depends(value: Node, on: Node) -> bool:
    return any(node is on for node in ordered([value]))
