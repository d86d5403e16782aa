"""Random expressions of the line language, typed: each is right for the kind that its place wants.

The grammar is tables of productions with weights. A production makes its text, or None where it has nothing to say.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from powderdsl.model.types import Kind
from powderdsl.testing.generators.names import SIDES, Names
from powderdsl.testing.generators.number import LIMIT, Number
from powderdsl.testing.generators.vocabulary import CHANCES

T = TypeVar("T")
Table = list[tuple[int, Callable[[], T | None]]]
"""Productions with their weights."""

ORDERS = ("<", ">", "<=", ">=", "==", "!=")
DECIMALS = ("0.5", "0.1", "1.5", "-0.25", "0.95", "3.3", "-7.125", "0.0001", "1e-7", "1000.5")


class Phrases(Names):
    """Makes expressions from words and local names. `depth` bounds their nesting."""

    def one_of(self, table: Table[T]) -> T:
        """The text of one of the productions, chosen by weight; productions that make nothing are skipped."""
        rows = list(table)
        while True:
            row = self.choices.weighted([(row[0], row) for row in rows])
            made = row[1]()
            if made is not None:
                return made
            rows.remove(row)

    def of_kind(self, kind: Kind, depth: int) -> str:
        """An expression that may be assigned to something of a kind."""
        makers: list[tuple[int, Callable[[int], object]]]
        match kind.name:
            case "int":
                return self.integer(depth).text
            case "real":
                makers = [(5, self.real), (1, self.integer), (1, self.flag), (1, self.draw)]
                return str(self.choices.weighted(makers)(depth))
            case "vec2":
                return self.vector(depth) if self.choices.below(10) < 9 else "0"
            case "element":
                return self.element(depth)
            case "direction":
                return self.direction(depth)
        return self.flag(depth, bare=True)

    def fitting(self, kind: Kind, depth: int) -> str:
        """Like `of_kind`; a constant lies in the kind's range, other values may lie outside."""
        if kind.name not in ("int", "real"):
            return self.of_kind(kind, depth)
        number = (self.integer if kind.name == "int" or not self.manner.reals else self.real)(depth)
        return (number.clamped(kind.lo, kind.hi) if number.fixed else number).text

    # Chances

    def chance(self, depth: int) -> str:
        """An expression for `with chance`."""
        return self.one_of(
            [
                (6, lambda: self.pick(*CHANCES)),
                (4, lambda: self._chance_name(depth)),
                (1, lambda: self._computed_chance(depth)),
            ]
        )

    def _chance_name(self, depth: int) -> str | None:
        names = [self._seen(name) for name, kind in self.words.properties.items() if kind.name == "chance"]
        names += [name for name, kind in self.words.params.items() if kind.name == "chance"]
        names += self.local("chance")
        if not names:
            return None
        name = self.pick(*names)
        if depth > 0 and self.choices.maybe(20):
            return f"({name} if {self.flag(depth - 1)} else {self.pick(*CHANCES)})"
        return name

    def _computed_chance(self, depth: int) -> str | None:
        number = self.integer(depth - 1) if self.choices.maybe(30) else self.real(depth - 1)
        return None if depth <= 0 or number.fixed else number.text

    # Conditions

    def flag(self, depth: int, bare: bool = False) -> str:
        """A condition. `bare`: a set of elements will do."""
        if bare and self.choices.maybe(25):
            return self.group()
        d = depth - 1
        table: Table[str] = [
            (4, self._presence),
            (3, lambda: self._named("flag")),
            (1, lambda: f"inside({self.place()})" if self.manner.borders else None),
            (1, lambda: self._param("flag")),
            (1, self._static),
        ]
        if depth <= 0:
            return self.one_of([*table, (1, lambda: self._compare_draw(depth))])
        table += [
            (4, lambda: self._compare_integer(d)),
            (2, lambda: self._compare_draw(depth)),
            (2, lambda: self._compare_real(d)),
            (3, lambda: self._both(d)),
            (2, lambda: f"(not {self.flag(d, bare=True)})"),
            (1, lambda: f"({self.flag(d)} {self.pick('==', '!=')} {self.flag(d)})"),
            (1, lambda: f"({self.flag(d)} if {self.flag(d, bare=True)} else {self.flag(d)})"),
            (1, lambda: self._quantified(d)),
            (1, lambda: self._is_element(depth)),
            (1, lambda: self._is_direction(depth)),
            (1, lambda: self._flag_there(d)),
        ]
        return self.one_of(table)

    def _presence(self) -> str:
        verb = self.pick("is", "is not", "in", "not in")
        return f"({self.place() if self.choices.maybe(70) else 'here'} {verb} {self.group()})"

    def _static(self) -> str:
        """A condition that is decided when rules are unrolled."""
        options = ["yes", "no", "2 < 3", *(f"{name} is {self.group()}" for name in self.local("one"))]
        options += [f"{name} == 1" for name in self.local("number")]
        options += [f"{name} is left" for name in self.sides()]
        options += [f"{name} in (left, below)" for name in self.sides()]
        return f"({self.pick(*options)})"

    def _compare_integer(self, depth: int) -> str:
        choices = self.choices
        left = self.integer(depth)
        if choices.maybe(15):
            lo, hi = sorted((choices.integer(-2, 6), choices.integer(-2, 6)))
            return f"({left} {self.pick('in', 'not in')} {lo}..{hi})"
        if choices.maybe(10):
            return (
                f"({left} {self.pick('<', '<=', '>', '>=', '==', '!=')} {self.pick('1.5', '0.25', '-0.5')})"
            )
        middle = self.integer(depth)
        text = f"{left} {self.pick('>', '<', '==', '>=', '<=', '!=')} {middle}"
        if choices.maybe(10):
            text += f" {self.pick('<', '<=', '==')} {self.integer(depth)}"
        return f"({text})"

    def _compare_draw(self, depth: int) -> str | None:
        if not self.words.streams:
            return None
        draw = self.draw(depth)
        order = self.pick("<", ">", "<=", ">=")
        if (draw.lo, draw.hi) == (0, 1):
            other = self.chance(depth - 1)
        else:
            other = self.pick("0.5", "1", "0", "1.25", "-0.5", "2.999")
            if self.choices.maybe(40):
                other = self.integer(depth - 1).text
        return f"({draw} {order} {other})" if self.choices.maybe(70) else f"({other} {order} {draw})"

    def draw(self, depth: int) -> Number:
        """A random number, maybe a neighbor's, maybe with an integer added; with bounds."""
        if not self.words.streams:
            return self.real(depth)
        name = self._seen(self.choices.pick(list(self.words.streams)))
        if depth <= 0 or self.choices.maybe(65):
            return Number(name, 0, 1)
        other = self.integer(depth - 1)
        if other.fixed:
            other = self._small()
        draw = Number(name, 0, 1)
        return [draw + other, other + draw, draw - other][self.choices.below(3)]

    def _compare_real(self, depth: int) -> str:
        other = self._number(3, depth)
        order = self.pick(*ORDERS)
        return f"({self.real(depth)} {order} {other})"

    def _both(self, depth: int) -> str:
        word = self.pick("and", "or")
        parts = [self.flag(depth, bare=True) for _ in range(self.choices.weighted([(4, 2), (1, 3)]))]
        return f"({f' {word} '.join(parts)})"

    def _quantified(self, depth: int) -> str:
        name = f"w{len(self.locals)}"
        kind, domain = self.domain()
        inner = self.bind(**{name: kind})
        return f"{self.pick('any', 'all')}({inner.flag(depth)} for {name} in {domain})"

    def _is_element(self, depth: int) -> str:
        left = self._element_value(depth)
        if self.choices.maybe(50):
            return f"({left} {self.pick('is', 'is not', 'in')} {self.group()})"
        return f"({left} {self.pick('==', '!=')} {self.element(depth - 1)})"

    def _is_direction(self, depth: int) -> str | None:
        if not (self.words.of_kind("direction") or self.words.of_kind("vec2")):
            return None
        left = self.runtime_direction(depth)
        sides = [*SIDES, *self.local("side")]
        return self.pick(
            f"({left} == {self.pick(*sides)})",
            f"({left} is {self.pick(*sides)})",
            f"({left} in ({self.pick(*sides)}, {self.pick(*sides)}))",
            f"({left} != {self.runtime_direction(depth - 1)})",
            f"({self.pick(*sides)} is {left})",
            f"({left} is not {self.runtime_direction(depth - 1)})",
        )

    def _flag_there(self, depth: int) -> str:
        """`left is CONDITION`: the condition as it is at a neighbor."""
        lets = self.lets("flag")
        inner = (
            self.pick(*lets)
            if lets and self.choices.maybe(70)
            else f"({self._compare_integer(depth)} or {self.flag(0)})"
        )
        return f"({self.place()} is {inner})"

    # Integers

    def integer(self, depth: int) -> Number:
        d = depth - 1
        table: Table[Number] = [
            (3, self._small),
            (6, self._integer_name),
            (2, self._integer_param),
            (2, self._loop_number),
        ]
        if depth > 0:
            table += [
                (4, lambda: self._count(d)),
                (2, lambda: self._sum(d)),
                (3, lambda: self._add(d)),
                (2, lambda: (self.integer(d) * self.integer(d)).within_limit()),
                (1, lambda: -self.integer(d)),
                (1, lambda: abs(self.integer(d))),
                (2, lambda: self._extreme(d)),
                (2, lambda: self._modulo(d)),
                (2, lambda: self._quotient(d)),
                (2, lambda: self._choose_integer(d)),
                (1, lambda: self.integer(d).clamped(-2, 3)),
            ]
        return self.one_of(table)

    def _small(self) -> Number:
        value = self.choices.pick([0, 1, 2, 3, -1, 5, 7, -4, 255])
        return Number(str(value), value, value, fixed=True)

    def _integer_name(self) -> Number | None:
        kinds = {**self.words.fields, **self.words.properties, **self.locals}
        names = [name for name, kind in kinds.items() if kind.name == "int"]
        if not names:
            return None
        name = self.pick(*names)
        return Number(self._seen(name), kinds[name].lo, kinds[name].hi)

    def _integer_param(self) -> Number | None:
        name = self._param("int")
        return Number(name, self.words.params[name].lo, self.words.params[name].hi) if name else None

    def _loop_number(self) -> Number | None:
        names = self.local("number")
        return Number(self.choices.pick(names), 0, 2, fixed=True) if names else None

    def _count(self, depth: int) -> Number:
        parts = [self.flag(depth, bare=True) for _ in range(self.choices.weighted([(4, 1), (1, 2)]))]
        kernel, weights = self._kernel()
        ends = sum(w for w in weights if w < 0), sum(w for w in weights if w > 0)
        return Number(f"count({', '.join(parts)}{kernel})", *ends)

    def _sum(self, depth: int) -> Number | None:
        value = self.integer(depth)
        kernel, weights = self._kernel()
        reach = value.reach * sum(map(abs, weights))
        if value.fixed or reach > LIMIT:
            return None
        return Number(f"sum({value}{kernel})", -reach, reach)

    def _add(self, depth: int) -> Number | None:
        a, b = self.integer(depth), self.integer(depth)
        if a.reach + b.reach > LIMIT:
            return None
        return a - b if self.choices.maybe(40) else a + b

    def _extreme(self, depth: int) -> Number:
        a, b = self.integer(depth), self.integer(depth)
        word, pick = self.choices.pick([("min", min), ("max", max)])
        return Number(f"{word}({a}, {b})", pick(a.lo, b.lo), pick(a.hi, b.hi), a.fixed and b.fixed)

    def _choose_integer(self, depth: int) -> Number:
        a, b = self.integer(depth), self.integer(depth)
        text = f"({a} if {self.flag(depth, bare=True)} else {b})"
        return Number(text, min(a.lo, b.lo), max(a.hi, b.hi), a.fixed or b.fixed)

    def _modulo(self, depth: int) -> Number:
        modulus = self.choices.pick([2, 3, 1, 4, 7, 64])
        borders = self.manner.borders
        inner = self.pick("row", "column", "step", "(row + step)", "(column - row)") if borders else "step"
        if self.choices.maybe(50):
            value = self.integer(depth)
            if not value.fixed and self.choices.maybe(60):
                inner = value.text
            elif not value.fixed:
                inner = (
                    f"({value} {self.pick('+', '-')} {self.pick('step', 'column' if borders else 'step')})"
                )
        return Number(f"({inner} mod {modulus})", 0, modulus - 1)

    def _quotient(self, depth: int) -> Number | None:
        """An integer division, by constants of both signs or by what may be 0."""
        choices = self.choices
        if self.manner.borders and choices.maybe(15):
            inner = self.pick("row", "(column + step)", "(row - 1)")
            return Number(f"({inner} div {choices.pick([1, 2, 3, 5])} mod {choices.pick([2, 3])})", 0, 2)
        value = self.integer(depth)
        if value.fixed:
            return None
        if choices.maybe(60):
            return value // choices.pick([2, 3, -2, 8, 1, -1, 7, -5, 64, 100, -64])
        divisor = self.integer(depth)
        return None if divisor.fixed else Number(f"({value} div {divisor})", -value.reach, value.reach)

    # Floats and vectors

    def _number(self, reals: int, depth: int) -> Number:
        """A float, or once in a while an integer."""
        return self.choices.weighted([(reals, self.real), (1, self.integer)])(depth)

    def real(self, depth: int) -> Number:
        d = depth - 1
        table: Table[Number] = [
            (3, lambda: Number(self.pick(*DECIMALS), fixed=True)),
            (4, lambda: _variable(self._named("real"))),
            (1, lambda: _variable(self._param("real"))),
        ]
        if depth > 0:
            table += [
                (4, lambda: self._real_arithmetic(d)),
                (2, lambda: self._divide(d)),
                (2, lambda: self._real_unary(d)),
                (2, lambda: self._real_extreme(d)),
                (2, lambda: self._component(d)),
                (1, lambda: Number(f"length({self.vector(d)})")),
                (1, lambda: self._real_sum(d)),
                (1, lambda: self._choose_real(d)),
                (1, lambda: self._scaled_draw(d)),
            ]
        return self.one_of(table)

    def _real_arithmetic(self, depth: int) -> Number | None:
        a, b = self.real(depth), self._number(3, depth)
        if a.fixed and b.fixed:
            return None
        first, second = (a, b) if self.choices.maybe(70) else (b, a)
        return Number(f"({first} {self.pick('+', '-', '*')} {second})")

    def _divide(self, depth: int) -> Number | None:
        a, b = self._number(2, depth), self._number(2, depth)
        if a.fixed and b.fixed:
            return None
        return Number(f"({a} / {self.pick('2', '3', '18', '0.3') if b.fixed else b})")

    def _real_unary(self, depth: int) -> Number:
        value = self.real(depth)
        text = self.pick(f"abs({value})", f"(-{value})", f"sin({value})", f"cos({value})")
        return Number(text, fixed=value.fixed and text[0] not in "sc")

    def _real_extreme(self, depth: int) -> Number:
        a, b = self.real(depth), self._number(2, depth)
        return Number(f"{self.pick('min', 'max')}({a}, {b})", fixed=a.fixed and b.fixed)

    def _component(self, depth: int) -> Number | None:
        if not self.words.of_kind("vec2") and self.choices.maybe(50):
            return None
        return Number(f"{self.vector(depth)}.{self.pick('row', 'column')}")

    def _real_sum(self, depth: int) -> Number:
        kernel, _ = self._kernel()
        return Number(f"sum({self.real(depth)}{kernel})")

    def _choose_real(self, depth: int) -> Number:
        a, b = self.real(depth), self._number(3, depth)
        return Number(f"({a} if {self.flag(depth, bare=True)} else {b})", fixed=a.fixed or b.fixed)

    def _scaled_draw(self, depth: int) -> Number | None:
        if not self.words.streams:
            return None
        if not self.choices.maybe(30):
            return Number(f"({self.draw(depth)} {self.pick('*', '/')} {self.pick('0.7', '2.5', '0.001')})")
        draw, sign, other = self.draw(depth), self.pick("+", "-"), self.real(depth)
        # A constant would have to be an integer here.
        return Number(
            f"({draw} {sign} {f'(0.5 * length(vector({other}, {other})))' if other.fixed else other})"
        )

    def vector(self, depth: int) -> str:
        d = depth - 1
        table: Table[str] = [(6, lambda: self._named("vec2")), (2, lambda: self._pair(d))]
        if depth > 0:
            table += [
                (3, lambda: f"({self.vector(d)} {self.pick('+', '-')} {self.vector(d)})"),
                (3, lambda: self._scaled(d)),
                (1, lambda: f"(-{self.vector(d)})"),
                (2, lambda: self._vector_sum(d)),
                (1, lambda: f"({self.vector(d)} if {self.flag(d, bare=True)} else {self.vector(d)})"),
            ]
        return self.one_of(table)

    def _pair(self, depth: int) -> str:
        makers: list[tuple[int, Callable[[int], object]]] = [
            (2, self.real),
            (2, self.integer),
            (1, self.flag),
        ]
        row, column = self.choices.weighted(makers)(depth), self.choices.weighted(makers)(depth)
        return f"vector({row}, {column})"

    def _scaled(self, depth: int) -> str:
        vector, factor = self.vector(depth), self._number(2, depth)
        by = self.pick("2", "0.5", "3") if factor.fixed else factor
        return self.pick(f"({vector} * {by})", f"({by} * {vector})", f"({vector} / {by})")

    def _vector_sum(self, depth: int) -> str:
        kernel, _ = self._kernel()
        return f"sum({self.vector(depth)}{kernel})"

    # Elements and directions

    def element(self, depth: int) -> str:
        if self.choices.maybe(45):
            return self._element_value(depth)
        return self.pick(*self.words.elements, *self.local("one"))

    def _element_value(self, depth: int) -> str:
        """An element that depends on the world."""
        name = self._named("element")
        value = self.pick(*([] if name is None else [name, name]), self.place(), "here")
        if depth > 0 and self.choices.maybe(20):
            return f"({value} if {self.flag(depth - 1, bare=True)} else {self.element(depth - 1)})"
        return value

    def direction(self, depth: int) -> str:
        if self.choices.maybe(50):
            return self.runtime_direction(depth)
        if self.words.streams and self.choices.maybe(20):
            sides = [self.pick(*SIDES) for _ in range(self.choices.integer(2, 4))]
            return f"pick({self.choices.pick(list(self.words.streams))}, {', '.join(sides)})"
        return self.pick(*SIDES, *self.local("side"))

    def runtime_direction(self, depth: int) -> str:
        """A direction that depends on the world."""
        if depth > 0 and self.choices.maybe(20):
            turn = self.pick("opposite", "clockwise", "counterclockwise")
            return f"{turn}({self.runtime_direction(depth - 1)})"
        name = self._named("direction")
        if name is None or (depth > 0 and self.choices.maybe(30)):
            return f"octant({self.vector(depth - 1)})"
        if depth > 0 and self.choices.maybe(20):
            return f"({name} if {self.flag(depth - 1, bare=True)} else {self.direction(depth - 1)})"
        return name


def _variable(name: str | None) -> Number | None:
    return None if name is None else Number(name)
