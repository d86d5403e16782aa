"""Values as named temporaries of a block, each computed once: the common part of the C++ and CUDA printers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Generic, TypeVar

from powderdsl.ir.ops import Node, ordered
from powderdsl.schedule.types import Compute

Named = TypeVar("Named")
"""What stands for a value in the text of a target: its name, or its code."""


class Values(Generic[Named]):
    """Statements of a block, and the names of the values that they compute, by id."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.known: dict[int, Named] = {}
        self.count = 0

    def needed(self, node: Node) -> Sequence[Node]:
        """The arguments that get names before a node does."""
        raise NotImplementedError

    def made(self, node: Node) -> None:
        """Name a node, by adding it to `known`."""
        raise NotImplementedError

    def of(self, root: Node) -> Named:
        """The name of a value."""
        stack = [(root, False)]
        while stack:
            node, ready = stack.pop()
            if id(node) in self.known:
                continue
            needed = () if ready else self.needed(node)
            if needed:
                stack.append((node, True))
                stack.extend((arg, False) for arg in reversed(needed))
            else:
                self.made(node)
        return self.known[id(root)]


class WordValues(Values[str]):
    """Flags, a word at a time. `type` is the type of a word; `leaf` is the operation whose arguments are read directly."""

    type: str
    leaf: str

    def node(self, node: Node) -> str:
        """The expression of a node whose arguments have names."""
        raise NotImplementedError

    def lazy(self, node: Node) -> str:
        """The name of a `when`; its second argument is computed only where the first holds."""
        raise NotImplementedError

    def needed(self, node: Node) -> Sequence[Node]:
        return node.args[:1] if node.op == "when" else () if node.op == self.leaf else node.args

    def made(self, node: Node) -> None:
        text = self.lazy(node) if node.op == "when" else self.node(node)
        self.known[id(node)] = text if text.isidentifier() else self.name(text)

    def name(self, text: str) -> str:
        self.count += 1
        self.lines.append(f"const {self.type} t{self.count} = {text};")
        return f"t{self.count}"


class CellValues(Values[Named]):
    """Floats, and flags that compare them. `choices` are all choices that the block computes."""

    choices: list[Node]

    def node(self, node: Node) -> Named:
        """The name or expression of a node whose arguments have names; a shift reads its argument directly."""
        raise NotImplementedError

    def led(self, node: Node) -> Named:
        """The name of a comparison that is computed only where its leader holds."""
        raise NotImplementedError

    def choice(self, node: Node) -> None:
        """Name a chain of choices."""
        raise NotImplementedError

    def needed(self, node: Node) -> Sequence[Node]:
        return () if node.op in ("select", "led", "shift") else node.args

    def made(self, node: Node) -> None:
        if node.op == "select":
            self.choice(node)
        else:
            self.known[id(node)] = self.led(node) if node.op == "led" else self.node(node)

    def chain(self, node: Node) -> list[Node]:
        """A choice and those below it in its third argument, the outermost first."""
        chain: list[Node] = []
        while node.op == "select" and id(node) not in self.known:
            chain.append(node)
            node = node.args[2]
        return chain

    def alike(self, node: Node) -> list[list[Node]]:
        """The chain of a choice, and others on the same masks: the components of a vector share their tests.

        None of them depends on another.
        """
        chains = [self.chain(node)]
        masks = [choice.args[0] for choice in chains[0]]
        for other in self.choices:
            chain = [] if other is node or id(other) in self.known else self.chain(other)
            same = len(chain) > 1 and [choice.args[0] for choice in chain] == masks
            if same and not any(_depends(other, one[0]) or _depends(one[0], other) for one in chains):
                chains.append(chain)
        return chains


def _depends(value: Node, on: Node) -> bool:
    return any(node is on for node in ordered([value]))


def chains_of(loop: Compute) -> list[list[Node]]:
    """The chains of choices of a loop, all on the same masks, the outermost choice first."""
    chains: dict[int, list[Node]] = {}
    below: set[int] = set()
    for node in reversed(ordered(out.value for out in loop.outs)):
        if node.op != "select" or id(node) in below:
            continue
        chain = []
        while node.op == "select":
            chain.append(node)
            below.add(id(node))
            node = node.args[2]
        chains[id(chain[0])] = chain
    return list(reversed(chains.values()))
