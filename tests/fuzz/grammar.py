"""The grammar of random rules: what each kind of phrase may be written as, how often, and of which other phrases.

`{place}` is a phrase of another kind, drawn from its own productions; `{p=place}` is one that `{p}` repeats.
Declarations and loops add productions of the kinds `int name`, `loop place`, `stream name` and so on: their names.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

from powderdsl.model.builtins import MAX_MAGNITUDE
from powderdsl.testing.generators.cases import Choices

T = TypeVar("T")
Reach = Callable[[list[float]], float]

HOLE = re.compile(r"\{(?:(\w+)=)?([\w ]+)\}")

ALTERNATIVE = re.compile(r'(?:(\d+)([*+]?) )?("?)(.*)\3')
"""How often a phrase is written so, how its reach follows from those of its parts, and its text, perhaps quoted."""


def largest(reaches: list[float]) -> float:
    """The largest of some magnitudes, 0 of none."""
    return max(reaches, default=0)


REACHES: dict[str, Reach] = {"": largest, "*": math.prod, "+": math.fsum}
"""By the sign after a weight."""


def weighted(choices: Choices, rows: Sequence[tuple[int, T]]) -> T:
    """One of the options, each as likely as its weight says."""
    number = choices.below(sum(weight for weight, _ in rows))
    for weight, option in rows:
        if number < weight:
            return option
        number -= weight
    raise AssertionError("weights must not be negative")


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
        """True if the phrase contains more than a single expression: its parts nest one level deeper."""
        texts, parts = self.pieces
        return any(texts) and any(kind in EXPRESSIONS for _, kind in parts)


Productions = tuple[Production, ...]


def named(name: str, reach: float = 0) -> Production:
    """A declared name or a number; `reach` is the largest magnitude that it may have."""
    return Production(1, name, lambda reaches: reach)


def productions(alternatives: str) -> Productions:
    """Alternatives between `|`, each with a weight before it if that is not 1.

    The reach of an integer is the product of those of its parts if `*` follows the weight, the sum if it is `+`, and
    else the largest. `; ` separates rules of one substep.
    """
    rows = []
    for part in alternatives.split(" | "):
        match = ALTERNATIVE.fullmatch(part)
        assert match is not None
        weight, sign, _, text = match.groups()
        rows.append(Production(int(weight or 1), text.replace("; ", "\n"), REACHES[sign or ""]))
    return tuple(rows)


def grammar(text: str) -> dict[str, Productions]:
    """The productions of each kind of phrase: `KIND = ALTERNATIVES`, continued on indented lines."""
    lines = re.sub(r"\n +", " ", text.strip()).splitlines()
    return {
        kind: productions(alternatives) for kind, alternatives in (line.split(" = ", 1) for line in lines)
    }


SEEN = "13 {KIND name} | 6 {place}.{KIND name} | {place}.{KIND name}?"
"""A named value here or at a neighbor, whose pack may be absent."""

WORDS: dict[str, Productions] = grammar("""
plus or minus = + | -
arithmetic = + | - | *
min or max = min | max
wave = sin | cos
any or all = any | all
and or or = and | or
is = is | is not | in | not in
in = in | not in
equals = == | !=
order = < | <= | > | >= | == | !=
less or more = < | > | <= | >=
turn = opposite | clockwise | counterclockwise
axis = row | column
literal = 0 | 1 | 2 | 3 | -1 | 5 | 7 | -4 | 255
level = 1 | 2 | 4 | {loop number}
range = 0..1 | -2..3 | 1..6 | 2..2
modulus = 1 | 2 | 3 | 4 | 7 | 64
divisor = 2 | 3 | -2 | 8 | 1 | -1 | 7 | -5 | 64 | 100 | -64
decimal = 0.5 | 0.1 | 1.5 | -0.25 | 0.95 | 3.3 | -7.125 | 0.0001 | 1e-7 | 1000.5
threshold = 0.5 | 1 | 0 | 1.25 | -0.5 | 2.999
chance literal = 50% | 0% | 100% | 20% | 0.001% | 99.99% | 0.1 | 33.3% | 0.0000152587890625
scale = 2 | 0.3 | 18 | 4 {varying number}
flag literal = no | yes
direction literal = right | above | left | below.left
element literal = {known element}
vec2 literal = vector(0, 0) | vector(1, -2) | vector(-0.5, 0.25) | vector(1, 0.25)
coordinate = row | column | (row + step) | (column - row)
clock = step | 4 {coordinate}
side = below | left | above | right | below.left | above.right
place = 6 {loop place} | opposite({loop place}) | below.{loop place} | {loop place}.left | 4 {side} | below.right |
    above.left | at(0, 2) | at(-2, 1) | at(3, 0) | at(-7, -15)
mover place = 20 {loop place} | 4 {side} | 2 at(0, 2) | at(-3, 1) | at(5, 0)
seen chance = 2 {chance property} | {place}.{chance property}
inside = inside({place})
decided flag = yes | no | (2 < 3) | ({loop element} is {group}) | ({loop number} == 1) | ({loop place} is left) |
    ({loop place} in (left, below))
member = {element word} | {element word} | {set name}
group = 8 {member} | 2 (any but {member}) | 2 ({member}, {member}) | ({member} or {member}) | any |
    ({member}, missing?)
known = {known element} | {known element} | {set name}
declared set = ({known}, {known}) | any but {known} | {known} or {known} | any but ({known}, {known}) |
    {known} and {known} | any
loop over side = (left, right) | (below, above.left) | octants | sides | diagonals
loop over number = 0..2 | 0..1
loop over element = {set name} | ({known element}, {known element})
loop over place = (at(0, 2), at(-3, 1))
loop = 4 side | 3 number | 2 element | place
""")  # fmt: skip
"""Phrases that are not expressions."""

WORDS["literal"] = tuple(named(row.text, abs(int(row.text))) for row in WORDS["literal"])
for _kind in ("flag", "int", "real", "vec2", "element", "direction", "stream"):
    WORDS[f"seen {_kind}"] = productions(SEEN.replace("KIND", _kind))

EXPRESSIONS: dict[str, Productions] = grammar("""
condition = {group} | 3 {flag}
flag = 3 ({place} {is} {group}) | (here {is} {group}) | 3 {seen flag} | {flag param} | {inside} | {decided flag} |
    ({seen stream} {less or more} {chance literal}) | 3 {compared integer} | 2 {compared draw} |
    2 ({real} {order} {number}) | 2 ({condition} {and or or} {condition}) |
    ({condition} and {condition} and {condition}) | 2 (not {condition}) | ({flag} {equals} {flag}) |
    ({flag} if {condition} else {flag}) | 2 {any or all}({flag of a loop}) | ({world element} {is} {group}) |
    ({world element} {equals} {element}) | ({world direction} {equals} {direction}) |
    ({world direction} is {side or loop}) | ({side or loop} is {world direction}) |
    ({world direction} is not {world direction}) | ({world direction} in ({side or loop}, {side or loop})) |
    ({place} is {flag let}) | ({place} is ({compared integer} or {flag}))
compared integer = 6 ({integer} {order} {integer}) | ({integer} {in} {range}) | ({integer} {order} {threshold}) |
    ({integer} < {integer} <= {integer}) | ({integer} >= {integer} == {integer})
compared draw = 3 ({seen stream} {less or more} {chance}) | ({chance} {less or more} {seen stream}) |
    ({draw} {less or more} {threshold}) | ({threshold} {less or more} {draw}) |
    ({draw} {less or more} {varying integer})
draw = ({seen stream} {plus or minus} {literal}) | ({varying integer} {plus or minus} {seen stream}) |
    ({seen stream} {plus or minus} {varying integer})
chance = 6 {chance literal} | 3 {seen chance} | 3 {chance param} | 3 ({seen chance} if {flag} else {chance literal}) |
    {varying integer} | {varying real}
flag let value = {flag}
vec2 let value = {vec2}
real let value = 9 {real} | ({real} + 0.0 * {real})
element let value = {world element}
direction let value = {world direction}
element value = {element}
direction value = {direction}
vec2 value = {vec2}
flag value = {condition}
int value = {varying integer}
real value = 3 {varying real} | {varying integer}
integer = 3 {literal} | 2 {loop number} | 16 {varying integer}
varying integer = 6 {seen int} | 2 {int param} | ({clock} mod {modulus}) | 4 count({condition}{kernel}) |
    count({condition}, {condition}{kernel}) | 2* sum({varying integer}{kernel}) |
    2+ ({varying integer} {plus or minus} {integer}) | 1+ ({integer} {plus or minus} {varying integer}) |
    2* ({varying integer} * {integer}) | (-{varying integer}) | abs({varying integer}) |
    clamp({varying integer}, -2, 3) | 3 {min or max}({varying integer}, {integer}) |
    ({varying integer} mod {modulus}) | (({varying integer} {plus or minus} {clock}) mod {modulus}) |
    ({varying integer} div {divisor}) | ({varying integer} div {varying integer}) | ({coordinate} div 2 mod 3) |
    ({coordinate} div 5 mod 2) | 2 ({varying integer} if {condition} else {integer})
number = 3 {real} | {integer}
varying number = 2 {varying real} | {varying integer}
real = 2 {decimal} | 6 {varying real} | abs({decimal}) | {wave}({decimal})
varying real = 4 {seen real} | {real param} | 3 ({varying real} {arithmetic} {number}) |
    ({number} {arithmetic} {varying real}) | ({varying real} / {scale}) | ({number} / {varying number}) |
    (-{varying real}) | abs({varying real}) | {wave}({varying real}) | 2 {min or max}({varying real}, {number}) |
    3 {vec2}.{axis} | 3 length({vec2}) | sum({varying real}{kernel}) | ({varying real} if {condition} else {number}) |
    ({seen stream} * 0.001) | ({seen stream} / 2.5) | ({seen stream} {plus or minus} {varying real})
vec2 = 6 {seen vec2} | 2 vector({component}, {component}) | 3 ({vec2} {plus or minus} {vec2}) | ({vec2} * {scale}) |
    ({scale} * {vec2}) | ({vec2} / {scale}) | (-{vec2}) | 2 sum({vec2}{kernel}) | ({vec2} if {condition} else {vec2})
component = 2 {real} | 2 {integer} | {flag}
element = {world element} | {element word}
world element = 3 {seen element} | {place} | here | ({place} if {condition} else {element}) |
    ({seen element} if {condition} else {element})
direction = 5 {world direction} | 4 {side or loop} | pick({stream name}, {side}, {side}) |
    pick({stream name}, {side}, {side}, {side})
side or loop = {side} | {loop side}
world direction = 7 {seen direction} | octant({seen vec2}) | 3 octant({vec2}) | 2 {turn}({world direction}) |
    2 ({seen direction} if {condition} else {direction})
""")  # fmt: skip
"""Expressions, which nest up to a depth. An integer that varies depends on the world: the compiler cannot fold it. A
value of `let` or `:=` is no constant, which could be out of a field's range."""

EXPRESSIONS["flag of a loop"] = ()  # made by the function of that name

RULES: dict[str, Productions] = grammar("""
transform = {subject} -> {element}{tail}
swap = 4 swap {mover place}{tail} | 6 {subject} swaps {mover place}{tail}
move = 4 {subject} moves {mover place} leaving {element word}{tail} |
    {subject} moves {p=mover place} leaving {p}{tail}
assign = {update}{where}{chance clause}
push = push {vec2 field} by {integer} away from {condition}{chance clause} |
    push {vec2 field} by {real} away from {condition}{chance clause}
subject = 3 {group} | 2 {condition}
tail = {if}{chance clause}{effects}
if = "" | 4 " if {condition}"
where = "" | 4 " where {condition}"
and more = 2 "" | 3 " and {flag}"
chance clause = 8 "" | , with chance {chance} | " with chance {chance}"
effects = 9 "" | , then {effect} | " then {effect}" | " then {effect}, {effect}"
proven transform = 2 {subject} -> {known element}{tail} |
    {subject} -> {target=known element}{tail}; {subject} -> {target}{tail} |
    {one=known element} -> {known element}{tail}; {another element} -> {known element}{tail}
proven swap = {one=element word} swaps {p=mover place} if {p} is not {one}{and more}{chance clause}{effects} |
    {g=group} swaps {p=mover place} if {p} is not {g}{and more}{chance clause}{effects} |
    swap {p=mover place} if {n=int property} == {level} > {p}.{n}{and more}{chance clause}{effects} |
    swap {p=mover place} if {f=flag name} and not {p}.{f}{and more}{chance clause}{effects}
proven move = {move}
proven movers = {one=known element} -> {element}{tail};
    {two=another element} swaps {p=mover place} if {p} is {another element}{chance clause}{effects} |
    {one=known element} moves {p=mover place} leaving {known element} if {p} is {two=another element}{chance clause};
    {another element} -> {element}{tail}
fallback transform = {group} -> {known element}
fallback swap = {one=known element} swaps below if below is not {one} and {decided flag} and no
""")  # fmt: skip
"""Rules, and parts of rules; proven ones can stand in one substep, as the checker can show that they have no conflicts.
`update` and `effect` are made by what knows the fields: see `rulemaker`."""


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
            row = weighted(self.choices, [(row.weight, row) for row in rows])
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
