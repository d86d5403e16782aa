"""The one driver of rewrites: rules by operation, applied bottom-up until none applies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from powderdsl.ir.build import Builder
from powderdsl.ir.ops import Node, PassGraph, nodes_of

Rewrite = Callable[[Node, Builder], Node | None]
"""From a node to its replacement, or None for no change."""


class RewriteLoop(AssertionError):
    """Rules that undo each other: a bug of ours."""


class Rules:
    """Rewrite rules by the operation that they apply to, in the order in which they are tried."""

    def __init__(self, *parts: Rules):
        self._by_op: dict[str, list[Rewrite]] = {}
        for part in parts:
            for op, rules in part._by_op.items():
                self._by_op.setdefault(op, []).extend(rules)

    def on(self, *ops: str) -> Callable[[Rewrite], Rewrite]:
        """Adds the decorated rule for some operations."""

        def add(rule: Rewrite) -> Rewrite:
            for op in ops:
                self._by_op.setdefault(op, []).append(rule)
            return rule

        return add

    def apply(self, node: Node, build: Builder) -> Node | None:
        """What the first rule that changes the node makes of it."""
        for rule in self._by_op.get(node.op, ()):
            found = rule(node, build)
            if found is not None and found is not node:
                return found
        return None


def rewrite_pass(pass_: PassGraph, rules: Rules) -> PassGraph:
    """The pass rebuilt bottom-up in a fresh graph, every node rewritten until no rule applies."""
    build = Builder()
    done: dict[int, Node] = {}
    """Nodes of the new graph by those of the old one."""
    final: dict[int, Node] = {}
    """What nodes of the new graph were rewritten to."""
    busy: set[int] = set()

    def finish(node: Node) -> Node:
        """A node of the new graph, rewritten. Arguments that a rule has made are finished first."""
        stack = [(node, False)]
        while stack:
            top, ready = stack.pop()
            if id(top) in final:
                continue
            if not ready:
                stack.append((top, True))
                stack.extend((arg, False) for arg in top.args if id(arg) not in final)
                continue
            args = tuple(final[id(arg)] for arg in top.args)
            same = all(a is b for a, b in zip(args, top.args, strict=True))
            rebuilt = top if same else build.rebuild(top, args)
            if id(rebuilt) not in final:
                final[id(rebuilt)] = rebuilt  # the replacement may contain the node itself
                found = rules.apply(rebuilt, build)
                if found is not None:
                    if id(found) in busy:
                        raise RewriteLoop(f"rules keep changing {found.op}")
                    busy.add(id(rebuilt))
                    final[id(rebuilt)] = finish(found)
                    busy.remove(id(rebuilt))
            final[id(top)] = final[id(rebuilt)]
        return final[id(node)]

    for node in nodes_of(pass_):
        build.place = node.places[0] if node.places else ""
        done[id(node)] = finish(build.rebuild(node, tuple(done[id(arg)] for arg in node.args)))
    substeps = tuple(
        replace(
            one,
            writes=tuple((slot, done[id(node)]) for slot, node in one.writes),
            guards=tuple(done[id(guard)] for guard in one.guards),
        )
        for one in pass_.substeps
    )
    outputs = tuple((slot, done[id(node)]) for slot, node in pass_.outputs)
    return replace(pass_, substeps=substeps, outputs=outputs)
