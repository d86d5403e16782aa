"""The one driver of rewrites: rules are functions from a node to its replacement, or None for no change."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from powderdsl.ir.build import Builder
from powderdsl.ir.ops import Node, PassGraph, Step, nodes_of

Rewrite = Callable[[Node, Builder], Node | None]

MAX_ROUNDS = 200


class RewriteLoop(AssertionError):
    """Rules that undo each other: a bug of ours."""


def rewrite_pass(pass_: PassGraph, rules: Sequence[Rewrite]) -> PassGraph:
    """The pass rebuilt bottom-up in a fresh graph, every node rewritten until no rule applies."""
    build = Builder()
    done: dict[int, Node] = {}

    def rewritten(node: Node) -> Node:
        """A node whose arguments are final; what a rule makes again is finished the same way."""
        for _ in range(MAX_ROUNDS):
            for rule in rules:
                found = rule(node, build)
                if found is not None and found is not node:
                    node = finish(found)
                    break
            else:
                return node
        raise RewriteLoop(f"rules keep changing {node.op}")

    final: dict[int, Node] = {}

    def finish(node: Node) -> Node:
        """Nodes of the new graph that a rule returned: their new arguments have not been looked at yet."""
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
            rebuilt = top if same else rebuild(top, args, build)
            if rebuilt is not top and id(rebuilt) in final:
                final[id(top)] = final[id(rebuilt)]
                continue
            final[id(top)] = rebuilt
            result = rebuilt
            for rule in rules:
                found = rule(rebuilt, build)
                if found is not None and found is not rebuilt:
                    result = rewritten(finish(found))
                    break
            final[id(top)] = final[id(rebuilt)] = result
        return final[id(node)]

    for node in nodes_of(pass_):
        build.place = node.places[0] if node.places else ""
        copy = rebuild(node, tuple(done[id(arg)] for arg in node.args), build)
        done[id(node)] = finish(copy)
    build.place = ""
    guards = {id(guard): _copy(guard, done, build, finish) for step in pass_.moments for guard in step.guards}
    moments = tuple(
        Step(
            step.label,
            step.place,
            tuple((slot, done[id(node)]) for slot, node in step.writes),
            tuple(guards[id(guard)] for guard in step.guards),
        )
        for step in pass_.moments
    )
    outputs = tuple((slot, done[id(node)]) for slot, node in pass_.outputs)
    return PassGraph(pass_.name, pass_.pack, moments, outputs)


def _copy(node: Node, done: dict[int, Node], build: Builder, finish: Callable[[Node], Node]) -> Node:
    """A guard may be a node that no write needs (its rule does nothing): it is copied too."""
    stack = [(node, False)]
    while stack:
        top, ready = stack.pop()
        if id(top) in done:
            continue
        if not ready:
            stack.append((top, True))
            stack.extend((arg, False) for arg in top.args)
        else:
            done[id(top)] = finish(rebuild(top, tuple(done[id(arg)] for arg in top.args), build))
    return done[id(node)]


def rebuild(node: Node, args: tuple[Node, ...], build: Builder) -> Node:
    """The same operation on other arguments; ranges are derived again where they follow from the arguments."""
    match node.op:
        case "add" | "sub" | "mul" | "min" | "max":
            return build.arithmetic(node.op, *args)
        case "select":
            return build.select(*args)
        case "swap" | "arrive":
            content, movers, rest = args
            move = build.swap if node.op == "swap" else build.arrive
            return move(content, movers, rest, node.attr)
        case "neg":
            return build.neg(*args)
        case "abs":
            return build.abs(*args)
        case "shift":
            dy, dx, wraps = node.attr
            return build.shift(args[0], (dy, dx), wraps)
        case "table":
            return build.table(args[0], node.attr)
    return build.make(node.op, node.type, *args, attr=node.attr)
