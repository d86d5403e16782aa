"""The syntax tree of one line: a kind from the grammar, children, and the place it came from."""

from __future__ import annotations

from dataclasses import dataclass, field

from powderdsl.diagnostics import Span


@dataclass(frozen=True)
class Syntax:
    """A node. `kind` is the grammar's rule or alias name; `text` is the token's text of leaves and operators.

    Spans take no part in equality, so trees compare by meaning.
    """

    kind: str
    children: tuple[Syntax, ...]
    text: str
    span: Span = field(compare=False, repr=False)

    def child(self, kind: str) -> Syntax | None:
        """The first child of a kind."""
        return next((child for child in self.children if child.kind == kind), None)

    def dump(self, indent: str = "") -> str:
        """The tree as indented text, one node a line."""
        head = f"{indent}{self.kind}" + (f" {self.text}" if self.text else "")
        return "\n".join([head, *(child.dump(indent + "  ") for child in self.children)])
