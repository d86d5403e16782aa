"""IR on planes -> the Python source of one pass: packed words for flags, float32 cells for reals.

The source is the same for all kinds of arrays; what it calls (`k`) is not: `targets.planes.program.PlaneKernels`,
`targets.arrays.program.ArrayKernels`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from powderdsl.ir.ops import REAL, Node, PassGraph
from powderdsl.targets.dense.source import comment
from powderdsl.targets.planes.plan import BLOCK, Moment, Plan, below, plan_pass

_WORDS = {"and": "&", "or": "|", "xor": "^"}
_REALS = {"add": "+", "sub": "-", "mul": "*"}
_COMPARE = {"eq": "==", "lt": "<", "le": "<="}
_PREFIX = {"block": "b", "cells": "s", "places": "p"}


class _Writer:
    """Lines of a pass. What is used for the last time is deleted, or overwritten by what comes of it."""

    def __init__(self, plan: Plan):
        self.plan = plan
        self.lines: list[str] = []
        self.indent = ""
        self.place = ""
        self.constants: dict[str, float] = {}
        self.names: dict[int, str] = {}
        self.count = 0
        self.outer: frozenset[str] = frozenset()
        """Names from outside the branch that is being written."""
        self.gone: list[str] = []
        """Those of them that were deleted in it."""
        self.own: set[int] = set()
        """Blocks, and reals with a number for each cell, in an array that nothing else refers to."""
        self.members: dict[int, list[Node]] = {}
        """Planes of each block that have names."""
        self.full: set[int] = set()
        """Reals with a number for each cell."""
        self.slots = {slot for slot, _ in plan.outputs}
        roots = [node for _, node in plan.outputs]
        self.uses = Counter(id(node) for node in roots)
        for moment in plan.moments:
            roots += [*moment.conditions, *(write.node for write in moment.writes)]
            if moment.conditions:
                olds = [write.old for write in moment.writes if write.old is not None]
                self.uses.update(id(node) for node in (*moment.conditions, *olds))
                roots += olds
        self.uses.update(id(arg) for node in below(roots) for arg in node.args)

    def line(self, text: str) -> None:
        self.lines.append(self.indent + text)

    def name(self, node: Node) -> str:
        return self.names[id(node)]

    def fresh(self, node: Node) -> str:
        self.count += 1
        self.names[id(node)] = name = f"{_PREFIX.get(node.type.name, 'n')}{self.count}"
        return name

    def spend(self, nodes: Iterable[Node]) -> None:
        """Count uses as made; what has no more is deleted."""
        dead = []
        for node in nodes:
            self.uses[id(node)] -= 1
            if self.uses[id(node)] == 0 and self.name(node)[0] in "nsbp":
                dead.append(self.name(node))
        if dead:
            self.line(f"del {', '.join(dead)}")
            self.gone += [name for name in dead if name in self.outer]

    def last(self, node: Node, user: Node) -> bool:
        """Whether an array may be overwritten by the result of its only user left."""
        seen = any(self.uses[id(member)] for member in self.members.get(id(node), ()))
        return id(node) in self.own and self.uses[id(node)] == user.args.count(node) and not seen

    # Moments

    def ensure(self, roots: Iterable[Node]) -> None:
        """Write what is missing of some nodes."""
        for node in below(roots, self.names):
            self.node(node)

    def moment(self, moment: Moment) -> None:
        if not moment.conditions:
            self.ensure(write.node for write in moment.writes)
            return
        # What is the same everywhere is what was there, or else the conditions hold.
        self.ensure(write.node for write in moment.writes if write.old is None or write.node.op == "const")
        self.ensure(moment.conditions)
        made = {id(write.node) for write in moment.writes}
        inner = below([write.node for write in moment.writes], self.names)
        self.ensure(node for node in inner if id(node) in self.plan.shared and id(node) not in made)
        pairs = [(write.node, write.old) for write in moment.writes if write.old is not None]
        self.ensure(old for _, old in pairs)
        # Blocks last: by then what else is made of their planes is made.
        pairs.sort(key=lambda pair: pair[0].type == BLOCK)
        pending = [(node, old) for node, old in pairs if id(node) not in self.names]
        if pending:
            self.branch(moment.conditions, pending)
        self.spend(moment.conditions)
        self.spend(old for node, old in pairs if (node, old) not in pending)

    def branch(self, conditions: tuple[Node, ...], writes: list[tuple[Node, Node]]) -> None:
        """Writes carried out if a condition holds somewhere; else all stays what it was."""
        owned = set(self.own)
        before = {id(old): self.name(old) for _, old in writes}
        self.line(f"if k.some({', '.join(map(self.name, conditions))}):")
        self.outer, self.gone = frozenset(self.names.values()), []
        # What the other branch does with what was there does not count in this one.
        self.uses.subtract(id(old) for _, old in writes)
        self.indent = "    "
        self.ensure(node for node, _ in writes)
        self.indent = ""
        gone, self.outer = self.gone, frozenset()
        renamed = [(self.name(node), before[id(old)]) for node, old in writes]
        otherwise = [f"{new} = {old}" for new, old in renamed if new != old]
        if gone:
            otherwise.append(f"del {', '.join(gone)}")
        if otherwise:
            self.line("else:")
            self.lines += [f"    {text}" for text in otherwise]
        olds = Counter(id(old) for _, old in writes)
        for node, old in writes:
            if not (id(old) in owned and self.uses[id(old)] == 0 and olds[id(old)] == 1):
                self.own -= {id(node), id(old)}
        kept = {self.name(node) for node, _ in writes}
        over = {before[id(old)] for _, old in writes if self.uses[id(old)] == 0} - {*gone} - kept
        dead = sorted(name for name in over if name[0] in "nsbp")
        if dead:
            self.line(f"del {', '.join(dead)}")

    # Operations

    def node(self, node: Node) -> None:
        if node.op == "const":
            self.constant(node)
            return
        if node.places and node.places[0] != self.place:
            self.place = node.places[0]
            self.line(f"# {comment(self.place)}")
        args = [self.name(arg) for arg in node.args]
        if node.type == REAL:
            self.real(node, args)
        else:
            expression = self.words(node, args)
            over = node.args[0] if node.op in ("swap", "leave") and self.last(node.args[0], node) else None
            if node.op == "member":
                self.members.setdefault(id(node.args[0]), []).append(node)
            elif node.type == BLOCK:
                self.own.add(id(node))
            self.assign(node, expression, over)

    def constant(self, node: Node) -> None:
        if node.type != REAL:
            self.names[id(node)] = "valid" if node.attr else "zero"
            return
        name = f"c{len(self.constants)}"
        self.constants[name] = float(node.attr)
        self.names[id(node)] = name

    def words(self, node: Node, args: list[str]) -> str:
        """What makes packed words, blocks of them, or bool cells."""
        attr = node.attr
        listed = ", ".join(args)
        match node.op:
            case "input":
                return f"state[{attr!r}]"
            case "param" | "coordinate" | "inside":
                return f"k.{node.op}({', '.join(map(repr, attr))})"
            case "chance" | "below_param":
                return f"k.{node.op}({', '.join([*map(repr, attr), *args])})"
            case "below_planes":
                count = attr[1] + 1
                where = "".join(f", {name}" for name in args[count:])
                return f"k.below({attr[0]!r}, {attr[1]}, ({', '.join(args[:count])},){where})"
            case "shift":
                return f"k.shift({args[0]}, {', '.join(map(str, attr))})"
            case "not":
                return f"{args[0]} ^ valid"
            case "and" | "or" | "xor":
                return f"{args[0]} {_WORDS[node.op]} {args[1]}"
            case "select":
                return f"{args[2]} ^ ({args[0]} & ({args[1]} ^ {args[2]}))"
            case "eq" | "lt" | "le":
                return f"k.pack({args[0]} {_COMPARE[node.op]} {args[1]})"
            case "cells" | "places":
                return f"k.{node.op}({args[0]})"
            case "moved":
                return f"k.moved({args[0]}, {attr[0]}, {attr[1]})"
            case "member":
                return f"{args[0]}[{attr}]"
            case "stack":
                return f"k.stack(({listed},))"
            case "arrive" | "swap_onto":
                return f"k.{node.op}({listed}, {attr[0]}, {attr[1]})"
            case "swap" | "leave":
                return f"k.{node.op}({listed}, {self.last(node.args[0], node)}, {', '.join(map(str, attr))})"
        raise AssertionError(f"no plane kernel for {node.op}")

    def real(self, node: Node, args: list[str]) -> None:
        """What makes reals: in the array of an argument, if its time ends here."""
        attr = node.attr
        listed = ", ".join(args)
        over: Node | None = None
        sign = _REALS.get(node.op)
        if node.op == "div" and node.args[1].op == "const" and node.args[1].attr:
            sign = "/"  # what divides by zero is a call
        if sign:
            places = (0, 1) if sign in "+*" else (0,)
            changed = next((i for i in places if self.last(node.args[i], node)), None)
            if changed is not None:
                over = node.args[changed]
                expression = f"{args[changed]} {sign}= {args[1 - changed]}"
            else:
                expression = f"{args[0]} {sign} {args[1]}"
        else:
            match node.op:
                case "input":
                    expression = f"state[{attr!r}]"
                case "param":
                    expression = f"k.param({', '.join(map(repr, attr))})"
                case "draw":
                    expression = f"k.draw_real({attr[0]!r}, {attr[1]})"
                case "shift":
                    expression = f"k.shift_cells({args[0]}, {', '.join(map(str, attr))})"
                case "neg":
                    expression = f"-{args[0]}"
                case "abs":
                    expression = f"abs({args[0]})"
                case "div" | "min" | "max" | "sqrt":
                    expression = f"k.{node.op}({listed})"
                case "settle":
                    over = node.args[0] if self.last(node.args[0], node) else None
                    expression = f"k.settle({args[0]}, {over is not None}, {attr[0]!r}, {attr[1]!r})"
                case "choose" | "update" | "carry":
                    place = 1 if node.op == "update" else 2
                    over = node.args[place] if self.last(node.args[place], node) else None
                    given = {"choose": (), "update": (attr,), "carry": attr}[node.op]
                    more = "".join(f", {value!r}" for value in given)
                    expression = f"k.{node.op}({listed}, {over is not None}{more})"
                case _:
                    raise AssertionError(f"no plane kernel for {node.op}")
        full = node.op in ("input", "draw", "shift", "choose", "update", "carry", "settle")
        if full or any(id(arg) in self.full for arg in node.args):
            self.full.add(id(node))
        shared = node.op in ("param", "draw") or (node.op == "input" and attr not in self.slots)
        if id(node) in self.full and not shared:
            self.own.add(id(node))
        if over is not None and sign:
            self.names[id(node)] = self.name(over)
            self.line(expression)
            self.uses[id(over)] = 0
            self.spend(arg for arg in node.args if arg is not over)
        else:
            self.assign(node, expression, over)

    def assign(self, node: Node, expression: str, over: Node | None) -> None:
        """A name for an operation's result: that of the argument that it overwrites, if it does."""
        if over is None:
            self.line(f"{self.fresh(node)} = {expression}")
            self.spend(node.args)
            return
        self.names[id(node)] = self.name(over)
        self.line(f"{self.name(over)} = {expression}")
        self.uses[id(over)] = 0
        self.spend(arg for arg in node.args if arg is not over)

    def returned(self) -> str:
        """What the pass changed. No two slots hold the same array of reals."""
        parts = []
        for slot, node in self.plan.outputs:
            alone = node.type != REAL or id(node) in self.own
            parts.append(f"{slot!r}: {self.name(node)}" if alone else f"{slot!r}: k.copy({self.name(node)})")
            self.own.discard(id(node))
        return ", ".join(parts)


def planes_pass_source(pass_: PassGraph, number: int) -> tuple[str, str, dict[str, float]]:
    """Source, function name and constants of a pass."""
    writer = _Writer(plan_pass(pass_))
    for moment in writer.plan.moments:
        writer.moment(moment)
    writer.ensure(node for _, node in writer.plan.outputs)
    name = f"pass_{number}"
    body = [
        f"def {name}(k, state):",
        "    valid, zero = k.valid, k.zero",
        *(f"    {line}" for line in writer.lines),
        f"    return {{{writer.returned()}}}",
    ]
    header = [
        f"# {comment(pass_.name)}",
        *(f"# {key} = {value!r}" for key, value in writer.constants.items()),
    ]
    return "\n".join(header + body) + "\n", name, writer.constants
