"""Scheduled statements -> CUDA C++: variables become buffers, barriers stand where threads see each other's words."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

from powderdsl.targets.cuda.schedule import (
    CellOutput,
    CellPhase,
    Finish,
    Guarded,
    Plan,
    Statement,
    WordPhase,
    names_of,
)

_VARIABLE = re.compile(r"\b([pfn])(\d+)\b")
_MACROS = {"p": "P", "f": "F", "n": "N"}


@dataclass
class Pending:
    """What threads did to buffers since the last barrier: (loop over words, at the own word only, written)."""

    done: dict[tuple[str, int], set[tuple[bool, bool, bool]]] = field(default_factory=dict)

    def clashes(self, buffer: tuple[str, int], words: bool, own: bool, written: bool) -> bool:
        """Whether a barrier must come before this access. Threads of loops over words have the same words in each."""
        return any(
            (written or before_written) and not (words and before_words and own and before_own)
            for before_words, before_own, before_written in self.done.get(buffer, ())
        )

    def add(self, buffer: tuple[str, int], words: bool, own: bool, written: bool) -> None:
        self.done.setdefault(buffer, set()).add((words, own, written))

    def join(self, other: Pending) -> None:
        for buffer, accesses in other.done.items():
            self.done.setdefault(buffer, set()).update(accesses)

    def copy(self) -> Pending:
        return Pending({buffer: set(accesses) for buffer, accesses in self.done.items()})


class Emitter:
    """Writes the statements of one pass."""

    def __init__(self, plan: Plan, pending: Pending):
        self.plan, self.pending = plan, pending
        self.lines: list[str] = []
        self.asked = 0

    def text(self, statements: Sequence[Statement]) -> str:
        for statement in statements:
            self.statement(statement)
        return "\n".join(self.lines)

    def statement(self, statement: Statement) -> None:
        match statement:
            case WordPhase():
                self.words(statement)
            case CellPhase():
                self.cells(statement)
            case Guarded():
                self.guarded(statement)
            case Finish():
                self.finish(statement)

    # Buffers and barriers

    def buffers(self, text: str) -> str:
        """The text with variables as buffers."""
        return _VARIABLE.sub(
            lambda m: f"{_MACROS[m[1]]}({self.plan.buffer[('f' if m[1] == 'n' else m[1]) + m[2]]})", text
        )

    def key(self, name: str) -> tuple[str, int]:
        return name[0], self.plan.buffer[name]

    def sync(self) -> None:
        self.lines.append("SYNC();")
        self.pending.done.clear()

    def access(self, accesses: Sequence[tuple[tuple[str, int], bool, bool, bool]]) -> None:
        """Note what a loop does; a barrier before it if need be. Each: buffer, over words, own word only, written."""
        if any(self.pending.clashes(*one) for one in accesses):
            self.sync()
        for one in accesses:
            self.pending.add(*one)

    def ask(self, flag: str, answer: str) -> None:
        """A barrier that tells every thread whether the flag holds in any."""
        self.lines.append(f"{answer} = ANY({flag});")
        self.pending.done.clear()

    def question(self) -> str:
        self.asked += 1
        return f"q{self.asked}"

    # Statements

    def words(self, phase: WordPhase, answer: str = "") -> None:
        reads = [(self.key(name), True, not across, False) for name, across in phase.reads.items()]
        across = {self.key(name) for name, far in phase.reads.items() if far}
        targets = [self.key(name) for name in names_of(phase)]
        held = any(target in across for target in targets)
        writes = [(target, True, True, True) for target in targets]
        self.access(reads if held else [*reads, *writes])
        flag = f"some_{answer}"
        lines = [f"bool {flag} = false;"] if phase.some else []
        if held:
            lines.append(f"u32 {', '.join(f'o_{name}[ROUNDS]' for name in names_of(phase))};")
        body = [*phase.lines]
        if phase.some:
            body.append(f"{flag} |= {phase.some};")
        for name, value in phase.outputs:
            body.append(f"o_{name}[k] = {value};" if held else f"const u32 o_{name} = {value};")
        if not held:
            body += [f"{name}[i] = o_{name};" for name in names_of(phase)]
        inner = "\n".join(body)
        lines.append(f"FOR_WORDS(k, i) {{ PLACE(i);\n{inner}\n}}")
        self.lines.append("{")
        self.lines.append(self.buffers("\n".join(lines)))
        if held:
            self.sync()
            self.access(writes)
            stores = " ".join(f"{name}[i] = o_{name}[k];" for name in names_of(phase))
            self.lines.append(self.buffers(f"FOR_WORDS(k, i) {{ {stores} }}"))
        if phase.some and answer:
            self.ask(flag, answer)
        self.lines.append("}")

    def cells(self, phase: CellPhase) -> None:
        if not phase.asked:
            self.cell_loop(phase)
            return
        answer = self.question()
        self.lines.append(f"bool {answer};")
        asked = {name: False for name in phase.reads if re.search(rf"\b[pfn]{name[1:]}\b", phase.asked)}
        self.words(WordPhase((), (), asked, f"({phase.asked}) != 0"), answer)
        before = self.pending.copy()
        self.lines.append(f"if ({answer}) {{")
        self.cell_loop(phase)
        after, self.pending = self.pending, before
        self.lines.append("} else {")
        for output in phase.outputs:
            self.quiet(output)
        self.lines.append("}")
        self.pending.join(after)

    def cell_loop(self, phase: CellPhase) -> None:
        reads = [(self.key(name), False, not across, False) for name, across in phase.reads.items()]
        keys = [self.key(output.name) for output in phase.outputs]
        self.access([*reads, *((key, False, True, True) for key in keys)])
        copied = any(o.keeps and self.key(o.keeps) != self.key(o.name) for o in phase.outputs)
        dirty = [f"n{o.name[1:]}[i]" for o in phase.outputs if o.name[0] == "f" and not o.keeps]
        need = "true" if not phase.busy or copied else " | ".join([f"(u32)({phase.busy})", *dirty])
        quiet = [f"{o.name}[i] = {o.quiet};" for o in phase.outputs if o.name[0] == "p"]
        lives = {o.name: f"n_{o.name}" for o in phase.outputs}
        before = "".join(f" u32 {name} = 0;" for name in lives.values())
        stores = []
        for o in phase.outputs:
            if o.name[0] == "f":
                stores.append(
                    f"{{ const float v = {o.value}; if (inside) {o.name}[cell] = v; BALLOT({lives[o.name]}, inside && v != 0); }}"
                )
            else:
                stores.append(f"BALLOT({lives[o.name]}, inside && {o.value});")
        ends = [
            f"{'n' + o.name[1:] if o.name[0] == 'f' else o.name}[i] = {lives[o.name]};" for o in phase.outputs
        ]
        test = (
            f"if ({need}) return true; {' '.join(quiet)} return false;" if need != "true" else "return true;"
        )
        self.lines.append(self.buffers("\n".join([
            f"FOR_BUSY_WORDS(i, [&](int i) {{ PLACE(i); {test} }}) {{ PLACE(i);{before}",
            *phase.words, "LANES { CELL;", *phase.lines, *stores, "}", f"ONCE {{ {' '.join(ends)} }}", "}",
        ])))  # fmt: skip

    def quiet(self, output: CellOutput) -> None:
        """An output where nothing is going on at all."""
        if output.name[0] == "p":
            self.words(WordPhase((), ((output.name, output.quiet),), {}))
        elif output.keeps:
            self.copy_fields([(output.name, output.keeps)])
        else:
            self.access([(self.key(output.name), False, True, True)])
            lives = "n" + output.name[1:]
            self.lines.append(self.buffers(
                f"FOR_BUSY_WORDS(i, [&](int i) {{ return {lives}[i] != 0; }}) {{ PLACE(i);\n"
                f"LANES {{ CELL; if (inside) {output.name}[cell] = 0; }} ONCE {lives}[i] = 0; }}"
            ))  # fmt: skip

    def guarded(self, statement: Guarded) -> None:
        answer = self.question()
        self.lines.append(f"bool {answer} = true;")
        skipped = Pending()
        for number, stage in enumerate(statement.stages):
            if number:
                skipped.join(self.pending)
                self.lines.append(f"if ({answer}) {{")
            for inner in stage[:-1]:
                self.statement(inner)
            last = stage[-1]
            assert isinstance(last, WordPhase)
            self.words(last, answer)
            if number:
                self.lines.append("}")
                self.pending.join(skipped)
        before = self.pending.copy()
        self.lines.append(f"if ({answer}) {{")
        for inner in statement.body:
            self.statement(inner)
        after, self.pending = self.pending, before
        self.lines.append("} else {")
        end = self.plan.position[id(statement)]
        copies = [(name, old) for name, old in statement.keeps if old and self.key(old) != self.key(name)]
        empty = [name for name, old in statement.keeps if not old and self.plan.last[name] > end]
        if copies or empty:
            outputs = (*((name, f"{old}[i]") for name, old in copies), *((name, "0") for name in empty))
            self.words(WordPhase((), outputs, {old: False for _, old in copies}))
        self.lines.append("}")
        self.pending.join(after)

    def finish(self, statement: Finish) -> None:
        """Copies into the slots' buffers; everything is read before anything is written."""
        pairs = [(name, number) for name, number in statement.pairs if self.plan.buffer[name] != number]
        planes = [(name, number) for name, number in pairs if name[0] == "p"]
        if planes:
            homes = {f"p_home{number}": number for _, number in planes}
            reads = {name: False for name, _ in planes}
            accesses = [(self.key(name), True, True, False) for name in reads]
            self.access([*accesses, *((("p", number), True, True, True) for number in homes.values())])
            loads = " ".join(f"const u32 o{number} = {name}[i];" for name, number in planes)
            stores = " ".join(f"P({number})[i] = o{number};" for _, number in planes)
            self.lines.append(f"FOR_WORDS(k, i) {{ {self.buffers(loads)} {stores} }}")
        self.copy_fields([(f"f_{number}", name) for name, number in pairs if name[0] == "f"])

    def copy_fields(self, pairs: Sequence[tuple[str, str]]) -> None:
        """Fields into others, cell by cell: (target, source); a target is a variable or ``f_`` and a slot's buffer."""
        numbers = [
            (int(to[2:]) if to[1] == "_" else self.plan.buffer[to], self.plan.buffer[source])
            for to, source in pairs
        ]
        numbers = [(to, source) for to, source in numbers if to != source]
        if not numbers:
            return
        self.access([
            *((("f", source), False, True, False) for _, source in numbers),
            *((("f", to), False, True, True) for to, _ in numbers),
        ])  # fmt: skip
        need = " | ".join(f"N({to})[i] | N({source})[i]" for to, source in numbers)
        words = " ".join(f"const u32 n{to} = N({source})[i];" for to, source in numbers)
        loads = " ".join(f"const float v{to} = F({source})[cell];" for to, source in numbers)
        stores = " ".join(f"F({to})[cell] = v{to};" for to, _ in numbers)
        ends = " ".join(f"N({to})[i] = n{to};" for to, _ in numbers)
        self.lines.append(
            f"FOR_BUSY_WORDS(i, [&](int i) {{ return ({need}) != 0; }}) {{ PLACE(i); {words}\n"
            f"LANES {{ CELL; {loads} if (inside) {{ {stores} }} }} ONCE {{ {ends} }} }}"
        )
