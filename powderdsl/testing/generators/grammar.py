"""The grammar of random rules: what each kind of phrase may be written as, how often, and of which other phrases.

In a text, `{place}` is a phrase of another kind, drawn from its own productions; `{p=place}` is one that `{p}` repeats.
Declarations and loops add productions of the kinds `int name`, `loop place`, `stream name` and so on: their names.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

from powderdsl.model.builtins import DIRECTION_SETS, MAX_MAGNITUDE
from powderdsl.model.operations import FUNCTIONS, NUMBER
from powderdsl.model.types import DIRECTION, REAL, VEC2, Kind
from powderdsl.testing.generators.choices import Choices

Reach = Callable[[list[float]], float]

HOLE = re.compile(r"\{(?:(\w+)=)?([\w ]+)\}")


def largest(reaches: list[float]) -> float:
    """The largest of some magnitudes, 0 of none."""
    return max(reaches, default=0)


@dataclass(frozen=True)
class Production:
    """A way to write a phrase. `reach` gives the largest magnitude of an integer from those of its parts."""

    weight: int
    text: str
    reach: Reach = largest

    @cached_property
    def pieces(self) -> tuple[list[str], list[tuple[str, str]]]:
        """The texts around the parts, and of each part the name by which it is repeated, if any, and its kind."""
        words = HOLE.split(self.text)
        return words[::3], [(name or "", kind) for name, kind in zip(words[1::3], words[2::3], strict=True)]

    @cached_property
    def nests(self) -> bool:
        """Whether the phrase contains expressions, and not one alone: its parts nest one level deeper."""
        texts, parts = self.pieces
        return any(texts) and any(kind in EXPRESSIONS for _, kind in parts)


Productions = tuple[Production, ...]


def either(*texts: str) -> Productions:
    """Texts that are equally likely."""
    return tuple(Production(1, text) for text in texts)


def weighted(*rows: tuple[int, str] | tuple[int, str, Reach]) -> Productions:
    """Texts with weights, and how the reach of an integer follows from its parts' where it is not the largest."""
    return tuple(Production(*row) for row in rows)


def named(name: str, reach: float = 0) -> Production:
    """A declared name; `reach` is the largest magnitude that it may have."""
    return Production(1, name, lambda reaches: reach)


def numbers(values: Iterable[int]) -> Productions:
    """Integers as they are written."""
    return tuple(named(str(value), abs(value)) for value in values)


def functions(count: int, takes: Kind, gives: Kind | None = None) -> list[str]:
    """The functions of so many arguments of a kind, by their rows in `operations`."""
    return [
        row.name
        for row in FUNCTIONS.values()
        if set(row.takes) == {takes} and row.gives == gives and len(row.parameters) == count
    ]


def calls(weight: int, argument: str, takes: Kind, gives: Kind | None = None) -> list[tuple[int, str]]:
    """A production for each function of one argument."""
    return [(weight, f"{name}({argument})") for name in functions(1, takes, gives)]


def seen(kind: str) -> Productions:
    """A named value here or at a neighbor, whose pack may be absent."""
    return weighted(
        (13, f"{{{kind} name}}"), (6, f"{{place}}.{{{kind} name}}"), (1, f"{{place}}.{{{kind} name}}?")
    )


WORDS: dict[str, Productions] = {
    "plus or minus": either("+", "-"),
    "arithmetic": either("+", "-", "*"),
    "min or max": either(*functions(2, NUMBER)),
    "wave": either(*functions(1, REAL, REAL)),
    "any or all": either("any", "all"),
    "and or or": either("and", "or"),
    "is": either("is", "is not", "in", "not in"),
    "in": either("in", "not in"),
    "equals": either("==", "!="),
    "order": either("<", "<=", ">", ">=", "==", "!="),
    "less or more": either("<", ">", "<=", ">="),
    "turn": either("opposite", "clockwise", "counterclockwise"),
    "axis": either("row", "column"),
    "literal": numbers((0, 1, 2, 3, -1, 5, 7, -4, 255)),
    "level": either("1", "2", "4", "{loop number}"),
    "range": either("0..1", "-2..3", "1..6", "2..2"),
    "modulus": either("1", "2", "3", "4", "7", "64"),
    "divisor": either("2", "3", "-2", "8", "1", "-1", "7", "-5", "64", "100", "-64"),
    "decimal": either("0.5", "0.1", "1.5", "-0.25", "0.95", "3.3", "-7.125", "0.0001", "1e-7", "1000.5"),
    "threshold": either("0.5", "1", "0", "1.25", "-0.5", "2.999"),
    "chance literal": either("50%", "0%", "100%", "20%", "0.001%", "99.99%", "0.1", "33.3%", "0.0000152587890625"),
    "scale": weighted((1, "2"), (1, "0.3"), (1, "18"), (4, "{varying number}")),
    "flag literal": either("no", "yes"),
    "direction literal": either("right", "above", "left", "below.left"),
    "element literal": either("{known element}"),
    "vec2 literal": either("vector(0, 0)", "vector(1, -2)", "vector(-0.5, 0.25)", "vector(1, 0.25)"),
    "coordinate": either("row", "column", "(row + step)", "(column - row)"),
    "clock": weighted((1, "step"), (4, "{coordinate}")),
    # Neighbors
    "side": either("below", "left", "above", "right", "below.left", "above.right"),
    "place": weighted(
        (6, "{loop place}"), (1, "opposite({loop place})"), (1, "below.{loop place}"), (1, "{loop place}.left"),
        (4, "{side}"), (1, "below.right"), (1, "above.left"),
        (1, "at(0, 2)"), (1, "at(-2, 1)"), (1, "at(3, 0)"), (1, "at(-7, -15)"),
    ),
    "mover place": weighted(
        (20, "{loop place}"), (4, "{side}"),
        (2, "at(0, 2)"), (1, "at(-3, 1)"), (1, "at(5, 0)"),
    ),
    # Named values
    **{f"seen {kind}": seen(kind) for kind in ("flag", "int", "real", "vec2", "element", "direction", "stream")},
    "seen chance": weighted((2, "{chance property}"), (1, "{place}.{chance property}")),
    "inside": either("inside({place})"),
    "decided flag": either(
        "yes", "no", "(2 < 3)", "({loop element} is {group})", "({loop number} == 1)", "({loop place} is left)",
        "({loop place} in (left, below))",
    ),
    # Sets of elements, and what loops are over
    "member": either("{element word}", "{element word}", "{set name}"),
    "group": weighted(
        (8, "{member}"), (2, "(any but {member})"), (2, "({member}, {member})"), (1, "({member} or {member})"),
        (1, "any"), (1, "({member}, missing?)"),
    ),
    "known": either("{known element}", "{known element}", "{set name}"),
    "declared set": either(
        "({known}, {known})", "any but {known}", "{known} or {known}", "any but ({known}, {known})", "{known} and {known}",
        "any",
    ),
    "loop over side": either("(left, right)", "(below, above.left)", *DIRECTION_SETS),
    "loop over number": either("0..2", "0..1"),
    "loop over element": either("{set name}", "({known element}, {known element})"),
    "loop over place": either("(at(0, 2), at(-3, 1))"),
    "loop": weighted((4, "side"), (3, "number"), (2, "element"), (1, "place")),
}  # fmt: skip
"""Phrases that are not expressions."""

EXPRESSIONS: dict[str, Productions] = {
    # Conditions
    "condition": weighted((1, "{group}"), (3, "{flag}")),
    "flag": weighted(
        (3, "({place} {is} {group})"), (1, "(here {is} {group})"), (3, "{seen flag}"), (1, "{flag param}"),
        (1, "{inside}"), (1, "{decided flag}"), (1, "({seen stream} {less or more} {chance literal})"),
        (3, "{compared integer}"), (2, "{compared draw}"),
        (2, "({real} {order} {number})"),
        (2, "({condition} {and or or} {condition})"), (1, "({condition} and {condition} and {condition})"),
        (2, "(not {condition})"), (1, "({flag} {equals} {flag})"), (1, "({flag} if {condition} else {flag})"),
        (2, "{any or all}({flag of a loop})"),
        (1, "({world element} {is} {group})"), (1, "({world element} {equals} {element})"),
        (1, "({world direction} {equals} {direction})"), (1, "({world direction} is {side or loop})"),
        (1, "({side or loop} is {world direction})"), (1, "({world direction} is not {world direction})"),
        (1, "({world direction} in ({side or loop}, {side or loop}))"),
        (1, "({place} is {flag let})"), (1, "({place} is ({compared integer} or {flag}))"),
    ),
    "flag of a loop": (),  # made by `phrases.flag_of_a_loop`
    "compared integer": weighted(
        (6, "({integer} {order} {integer})"), (1, "({integer} {in} {range})"), (1, "({integer} {order} {threshold})"),
        (1, "({integer} < {integer} <= {integer})"), (1, "({integer} >= {integer} == {integer})"),
    ),
    "compared draw": weighted(
        (3, "({seen stream} {less or more} {chance})"), (1, "({chance} {less or more} {seen stream})"),
        (1, "({draw} {less or more} {threshold})"), (1, "({threshold} {less or more} {draw})"),
        (1, "({draw} {less or more} {varying integer})"),
    ),
    "draw": weighted(
        (1, "({seen stream} {plus or minus} {literal})"), (1, "({varying integer} {plus or minus} {seen stream})"),
        (1, "({seen stream} {plus or minus} {varying integer})"),
    ),
    "chance": weighted(
        (6, "{chance literal}"), (3, "{seen chance}"), (3, "{chance param}"), (3, "({seen chance} if {flag} else {chance literal})"),
        (1, "{varying integer}"), (1, "{varying real}"),
    ),
    # Values of `let` and of `:=`: a constant out of a field's range would be an error
    **{f"{kind} let value": either(f"{{{kind}}}") for kind in ("flag", "vec2")},
    "real let value": weighted((9, "{real}"), (1, "({real} + 0.0 * {real})")),
    "element let value": either("{world element}"),
    "direction let value": either("{world direction}"),
    **{f"{kind} value": either(f"{{{kind}}}") for kind in ("element", "direction", "vec2")},
    "flag value": either("{condition}"),
    "int value": either("{varying integer}"),
    "real value": weighted((3, "{varying real}"), (1, "{varying integer}")),
    # Integers: a varying one depends on the world, so that the compiler cannot fold it
    "integer": weighted((3, "{literal}"), (2, "{loop number}"), (16, "{varying integer}")),
    "varying integer": weighted(
        (6, "{seen int}"), (2, "{int param}"), (1, "({clock} mod {modulus})"),
        (4, "count({condition}{kernel})"), (1, "count({condition}, {condition}{kernel})"),
        (2, "sum({varying integer}{kernel})", math.prod),
        (2, "({varying integer} {plus or minus} {integer})", math.fsum),
        (1, "({integer} {plus or minus} {varying integer})", math.fsum),
        (2, "({varying integer} * {integer})", math.prod),
        (1, "(-{varying integer})"), *calls(1, "{varying integer}", NUMBER), (1, "clamp({varying integer}, -2, 3)"),
        (3, "{min or max}({varying integer}, {integer})"),
        (1, "({varying integer} mod {modulus})"), (1, "(({varying integer} {plus or minus} {clock}) mod {modulus})"),
        (1, "({varying integer} div {divisor})"), (1, "({varying integer} div {varying integer})"),
        (1, "({coordinate} div 2 mod 3)"), (1, "({coordinate} div 5 mod 2)"),
        (2, "({varying integer} if {condition} else {integer})"),
    ),
    # Floats and vectors
    "number": weighted((3, "{real}"), (1, "{integer}")),
    "varying number": weighted((2, "{varying real}"), (1, "{varying integer}")),
    "real": weighted((2, "{decimal}"), (6, "{varying real}"), *calls(1, "{decimal}", NUMBER), (1, "{wave}({decimal})")),
    "varying real": weighted(
        (4, "{seen real}"), (1, "{real param}"),
        (3, "({varying real} {arithmetic} {number})"), (1, "({number} {arithmetic} {varying real})"),
        (1, "({varying real} / {scale})"), (1, "({number} / {varying number})"),
        (1, "(-{varying real})"), *calls(1, "{varying real}", NUMBER), (1, "{wave}({varying real})"),
        (2, "{min or max}({varying real}, {number})"),
        (3, "{vec2}.{axis}"), *calls(3, "{vec2}", VEC2, REAL), (1, "sum({varying real}{kernel})"),
        (1, "({varying real} if {condition} else {number})"),
        (1, "({seen stream} * 0.001)"), (1, "({seen stream} / 2.5)"), (1, "({seen stream} {plus or minus} {varying real})"),
    ),
    "vec2": weighted(
        (6, "{seen vec2}"), (2, "vector({component}, {component})"), (3, "({vec2} {plus or minus} {vec2})"),
        (1, "({vec2} * {scale})"), (1, "({scale} * {vec2})"), (1, "({vec2} / {scale})"), (1, "(-{vec2})"),
        (2, "sum({vec2}{kernel})"), (1, "({vec2} if {condition} else {vec2})"),
    ),
    "component": weighted((2, "{real}"), (2, "{integer}"), (1, "{flag}")),
    # Elements and directions
    "element": weighted((1, "{world element}"), (1, "{element word}")),
    "world element": weighted(
        (3, "{seen element}"), (1, "{place}"), (1, "here"), (1, "({place} if {condition} else {element})"),
        (1, "({seen element} if {condition} else {element})"),
    ),
    "direction": weighted(
        (5, "{world direction}"), (4, "{side or loop}"), (1, "pick({stream name}, {side}, {side})"),
        (1, "pick({stream name}, {side}, {side}, {side})"),
    ),
    "side or loop": weighted((1, "{side}"), (1, "{loop side}")),
    "world direction": weighted(
        (7, "{seen direction}"), *calls(1, "{seen vec2}", VEC2, DIRECTION), *calls(3, "{vec2}", VEC2, DIRECTION), (2, "{turn}({world direction})"),
        (2, "({seen direction} if {condition} else {direction})"),
    ),
}  # fmt: skip
"""Expressions, which nest up to a depth."""

RULES: dict[str, Productions] = {
    "transform": either("{subject} -> {element}{tail}"),
    "swap": weighted((4, "swap {mover place}{tail}"), (6, "{subject} swaps {mover place}{tail}")),
    "move": weighted(
        (4, "{subject} moves {mover place} leaving {element word}{tail}"),
        (1, "{subject} moves {p=mover place} leaving {p}{tail}"),
    ),
    "assign": either("{update}{where}{chance clause}"),
    "push": either(
        "push {vec2 field} by {integer} away from {condition}{chance clause}",
        "push {vec2 field} by {real} away from {condition}{chance clause}",
    ),
    # Parts of rules
    "subject": weighted((3, "{group}"), (2, "{condition}")),
    "tail": either("{if}{chance clause}{effects}"),
    "if": weighted((1, ""), (4, " if {condition}")),
    "where": weighted((1, ""), (4, " where {condition}")),
    "and more": weighted((2, ""), (3, " and {flag}")),
    "chance clause": weighted((8, ""), (1, ", with chance {chance}"), (1, " with chance {chance}")),
    "effects": weighted(
        (9, ""), (1, ", then {effect}"), (1, " then {effect}"), (1, " then {effect}, {effect}"),
    ),
    # Rules of one substep that the checker can prove to be free of conflicts
    "proven transform": weighted(
        (2, "{subject} -> {known element}{tail}"),
        (1, "{subject} -> {target=known element}{tail}\n{subject} -> {target}{tail}"),
        (1, "{one=known element} -> {known element}{tail}\n{another element} -> {known element}{tail}"),
    ),
    "proven swap": weighted(
        (1, "{one=element word} swaps {p=mover place} if {p} is not {one}{and more}{chance clause}{effects}"),
        (1, "{g=group} swaps {p=mover place} if {p} is not {g}{and more}{chance clause}{effects}"),
        (1, "swap {p=mover place} if {n=int property} == {level} > {p}.{n}{and more}{chance clause}{effects}"),
        (1, "swap {p=mover place} if {f=flag name} and not {p}.{f}{and more}{chance clause}{effects}"),
    ),
    "proven move": either("{move}"),
    "proven movers": either(
        "{one=known element} -> {element}{tail}\n"
        "{two=another element} swaps {p=mover place} if {p} is {another element}{chance clause}{effects}",
        "{one=known element} moves {p=mover place} leaving {known element} if {p} is {two=another element}{chance clause}\n"
        "{another element} -> {element}{tail}",
    ),
    "fallback transform": either("{group} -> {known element}"),
    "fallback swap": either("{one=known element} swaps below if below is not {one} and {decided flag} and no"),
}  # fmt: skip
"""Rules, and parts of rules. `update` and `effect` are made by what knows the fields: see `rulemaker`."""


# Phrases: one walk through the grammar, whose names are those that a ruleset and its loops declare

LIMIT = MAX_MAGNITUDE // 2
"""Largest magnitude of an integer expression."""

LOOP_NAMES = {
    "side": ("loop side", "loop place"),
    "place": ("loop place",),
    "element": ("loop element", "element word"),
    "number": ("loop number",),
}
"""The kinds of phrases that a loop variable is, by what the loop is over."""


@dataclass(frozen=True)
class Phrase:
    """A text; of an integer, its largest magnitude too."""

    text: str
    reach: float = 0


Maker = Callable[["Phrases", int], "Phrase | None"]
"""Makes a phrase that no text describes, from the phrases that are known and the depth that is left."""


@dataclass(frozen=True)
class Phrases:
    """Draws phrases by the grammar and by makers of single kinds."""

    choices: Choices
    grammar: Mapping[str, Productions]
    makers: Mapping[str, Maker]
    loops: int = 0

    def bound(self, name: str, *kinds: str, reach: float = 0) -> Phrases:
        """The same with a name that is a phrase of some kinds."""
        more = {kind: (*self.grammar.get(kind, ()), named(name, reach)) for kind in kinds}
        return replace(self, grammar={**self.grammar, **more})

    def looping(self, name: str) -> tuple[str, Phrases]:
        """A loop, `name in DOMAIN`, and what is known inside."""
        over = self.text("loop", 0)
        inside = self.bound(name, *LOOP_NAMES[over], reach=2)
        return f"{name} in {self.text(f'loop over {over}', 0)}", replace(inside, loops=self.loops + 1)

    def text(self, kind: str, depth: int) -> str:
        """A phrase of a kind that can always be drawn."""
        phrase = self.draw(kind, depth)
        assert phrase is not None, kind
        return phrase.text

    def draw(self, kind: str, depth: int) -> Phrase | None:
        """A phrase of a kind that nests at most this deep; None if there is none."""
        if kind in self.makers:
            return self.makers[kind](self, depth)
        rows = [row for row in self.grammar.get(kind, ()) if depth > 0 or not row.nests]
        while rows:
            row = self.choices.weighted([(row.weight, row) for row in rows])
            phrase = self.filled(row, depth - row.nests)
            if phrase is not None and phrase.reach <= LIMIT:
                return phrase
            rows.remove(row)
        return None

    def filled(self, row: Production, depth: int) -> Phrase | None:
        """A production with its parts drawn; None if one of them cannot be."""
        (text, *literals), parts = row.pieces
        repeated: dict[str, str] = {}
        reaches: list[float] = []
        for (name, kind), literal in zip(parts, literals, strict=True):
            if kind in repeated:
                text += repeated[kind] + literal
                continue
            part = self._another(repeated) if kind == "another element" else self.draw(kind, depth)
            if part is None:
                return None
            if name:
                repeated[name] = part.text
            reaches.append(part.reach)
            text += part.text + literal
        return Phrase(text, row.reach(reaches))

    def _another(self, taken: Mapping[str, str]) -> Phrase | None:
        """An element that is none of those that the phrase repeats."""
        names = [row.text for row in self.grammar["known element"] if row.text not in taken.values()]
        return Phrase(self.choices.pick(names)) if names else None


def flag_of_a_loop(phrases: Phrases, depth: int) -> Phrase:
    """A condition for each value of a variable, inside `any` or `all`."""
    loop, inside = phrases.looping(f"w{phrases.loops}")
    return Phrase(f"{inside.text('flag', depth)} for {loop}")
