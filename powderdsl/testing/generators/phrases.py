"""Random expressions of the line language, typed: each is right for the kind that its place wants."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from powderdsl.model.types import Kind
from powderdsl.testing.generators import real_phrases, whole_phrases
from powderdsl.testing.generators.choices import Choices
from powderdsl.testing.generators.phrase import LIMIT, NUMBER, ONE, PLACE, PLACES, SIDE, SIDES, Phrase
from powderdsl.testing.generators.vocabulary import CHANCES, Manner, Words


@dataclass(frozen=True)
class Phrases:
    """Makes expressions from words and local names. `depth` bounds their nesting."""

    choices: Choices
    words: Words
    manner: Manner
    locals: dict[str, Kind]
    scratch: dict[str, Kind]
    """Fields of the pass; they are locals of their own kind too."""

    def bind(self, **names: Kind) -> Phrases:
        return replace(self, locals={**self.locals, **names})

    def _one(self, rows: Sequence[tuple[int, Callable[[int], Phrase | None]]], depth: int) -> Phrase:
        """One of the makers by weight; those that find nothing to say are passed over."""
        rows = list(rows)
        while True:
            maker = self.choices.weighted([(weight, row) for row in rows for weight in row[:1]])
            phrase = maker[1](depth)
            if phrase is not None:
                return phrase
            rows.remove(maker)

    def of_kind(self, kind: Kind, depth: int) -> str:
        """An expression that may be assigned to something of a kind."""
        match kind.name:
            case "int":
                return self.whole(depth).text
            case "real":
                return self.choices.weighted(
                    [(5, self.real), (1, self.whole), (1, self.flag), (1, self.draw)]
                )(depth).text
            case "vec2":
                return self.choices.weighted([(9, self.vector), (1, lambda _: Phrase("0"))])(depth).text
            case "element":
                return self.element(depth).text
            case "direction":
                return self.direction(depth).text
        return self.flag(depth, bare=True).text

    def fitting(self, kind: Kind, depth: int) -> str:
        """Like `of_kind`; a constant lies in the kind's range, other values may lie outside."""
        if kind.name not in ("int", "real"):
            return self.of_kind(kind, depth)
        phrase = (self.whole if kind.name == "int" or not self.manner.reals else self.real)(depth)
        if not phrase.fixed:
            return phrase.text
        return f"clamp({phrase.text}, {kind.lo:g}, {kind.hi:g})"

    # Names

    def place(self) -> str:
        """A neighbor."""
        loops = self.sides()
        if loops and self.choices.maybe(60):
            side = self.choices.pick(loops)
            return self.choices.weighted(
                [(6, side), (1, f"opposite({side})"), (1, f"below.{side}"), (1, f"{side}.left")]
            )
        return self.choices.pick(PLACES)

    def _locals(self, *kinds: str) -> list[str]:
        return [name for name, k in self.locals.items() if k.name in kinds]

    def sides(self) -> list[str]:
        """Loop variables that are neighbors."""
        return self._locals("place", "side")

    def ones(self) -> list[str]:
        """Loop variables that are elements."""
        return self._locals("one")

    def lets(self, kind: str) -> list[str]:
        """Values of a kind that were fixed earlier."""
        return [name for name in self._locals(kind) if name not in self.scratch]

    def a_number(self) -> str:
        """A number known when rules are unrolled."""
        return self.choices.pick([*self._locals("number"), "1", "2", "4"])

    def _seen(self, name: str) -> str:
        """A value, here or at a neighbor."""
        if not self.choices.maybe(35):
            return name
        return f"{self.place()}.{name}" + ("?" if self.choices.maybe(10) else "")

    def _named(self, kind: str) -> str | None:
        """A field, property, let or scratch field of a kind, here or at a neighbor."""
        names = [*self.words.of_kind(kind), *self._locals(kind)]
        return self._seen(self.choices.pick(names)) if names else None

    def _param(self, kind: str) -> str | None:
        names = [name for name, k in self.words.params.items() if k.name == kind]
        return self.choices.pick(names) if names else None

    def group(self) -> str:
        """A set of elements."""
        choices = self.choices
        names = [*self.words.elements, *self.words.groups, *self._locals("one")]
        one, other = choices.pick(names), choices.pick(names)
        return choices.weighted(
            [
                (8, one),
                (2, f"(any but {one})"),
                (2, f"({one}, {other})"),
                (1, f"({one} or {other})"),
                (1, "any"),
                (1, f"({one}, missing?)"),
            ]
        )

    def kernel(self) -> str | None:
        """A kernel's name, or None for the default."""
        return self.choices.pick(
            [*self.words.kernels] if not self.manner.borders else [None, *self.words.kernels]
        )

    def chance(self, depth: int) -> str:
        """What may stand after `with chance`."""
        return self._one(
            [(6, self._chance_literal), (4, self._chance_name), (1, self._real_chance)], depth
        ).text

    def _chance_literal(self, depth: int) -> Phrase:
        return Phrase(self.choices.pick(CHANCES), fixed=True)

    def _chance_name(self, depth: int) -> Phrase | None:
        own = [name for name, kind in self.words.properties.items() if kind.name == "chance"]
        names = [
            *[self._seen(name) for name in own],
            *(n for n, k in self.words.params.items() if k.name == "chance"),
            *self._locals("chance"),
        ]
        if not names:
            return None
        name = self.choices.pick(names)
        if depth > 0 and self.choices.maybe(20):
            return Phrase(f"({name} if {self.flag(depth - 1).text} else {self.choices.pick(CHANCES)})")
        return Phrase(name)

    def _real_chance(self, depth: int) -> Phrase | None:
        phrase = self.whole(depth - 1) if self.choices.maybe(30) else self.real(depth - 1)
        return None if depth <= 0 or phrase.fixed else phrase

    # Conditions

    def flag(self, depth: int, bare: bool = False) -> Phrase:
        """A condition. `bare`: a set of elements will do."""
        if bare and self.choices.maybe(25):
            return Phrase(self.group())
        leaves = [
            (4, self._presence),
            (3, self._flag_name),
            (1, self._inside),
            (1, self._flag_param),
            (1, self._static),
        ]
        trees = [
            (4, self._compare_whole), (2, self._compare_draw), (2, self._compare_real), (3, self._both), (2, self._not),
            (1, self._same), (1, self._choose_flag), (1, self._quantified), (1, self._is_element), (1, self._is_direction),
            (1, self._flag_there),
        ]  # fmt: skip
        return self._one(leaves + (trees if depth > 0 else [(1, self._compare_draw)]), depth)

    def _presence(self, depth: int) -> Phrase:
        verb = self.choices.pick(["is", "is not", "in", "not in"])
        return Phrase(f"({self.place() if self.choices.maybe(70) else 'here'} {verb} {self.group()})")

    def _flag_name(self, depth: int) -> Phrase | None:
        name = self._named("flag")
        return None if name is None else Phrase(name)

    def _flag_param(self, depth: int) -> Phrase | None:
        name = self._param("flag")
        return None if name is None else Phrase(name)

    def _inside(self, depth: int) -> Phrase | None:
        return Phrase(f"inside({self.place()})") if self.manner.borders else None

    def _static(self, depth: int) -> Phrase:
        """What is known when rules are unrolled."""
        one, number, side = self._locals("one"), self._locals("number"), self.sides()
        options = ["yes", "no", "2 < 3", *(f"{name} is {self.group()}" for name in one)]
        options += [*(f"{name} == 1" for name in number), *(f"{name} is left" for name in side)]
        options += [f"{name} in (left, below)" for name in side]
        return Phrase(f"({self.choices.pick(options)})", fixed=True)

    def _compare_whole(self, depth: int) -> Phrase:
        choices = self.choices
        left = self.whole(depth - 1)
        if choices.maybe(15):
            lo, hi = sorted((choices.whole(-2, 6), choices.whole(-2, 6)))
            return Phrase(f"({left.text} {choices.pick(['in', 'not in'])} {lo}..{hi})")
        if choices.maybe(10):
            return Phrase(
                f"({left.text} {choices.pick(['<', '<=', '>', '>=', '==', '!='])} {choices.pick(['1.5', '0.25', '-0.5'])})"
            )
        middle = self.whole(depth - 1)
        text = f"{left.text} {choices.pick(['>', '<', '==', '>=', '<=', '!='])} {middle.text}"
        if choices.maybe(10):
            text += f" {choices.pick(['<', '<=', '=='])} {self.whole(depth - 1).text}"
        return Phrase(f"({text})")

    def _compare_draw(self, depth: int) -> Phrase | None:
        if not self.words.streams:
            return None
        draw = self.draw(depth)
        order = self.choices.pick(["<", ">", "<=", ">="])
        other = (
            self.chance(depth - 1)
            if (draw.lo, draw.hi) == (0, 1)
            else self.choices.pick(["0.5", "1", "0", "1.25", "-0.5", "2.999"])
        )
        if (draw.lo, draw.hi) != (0, 1) and self.choices.maybe(40):
            other = self.whole(depth - 1).text
        return Phrase(
            f"({draw.text} {order} {other})" if self.choices.maybe(70) else f"({other} {order} {draw.text})"
        )

    def draw(self, depth: int) -> Phrase:
        """A random number, maybe a neighbor's, maybe with a whole number added; with bounds."""
        if not self.words.streams:
            return self.real(depth)
        name = self._seen(self.choices.pick(list(self.words.streams)))
        if depth <= 0 or self.choices.maybe(65):
            return Phrase(name, 0, 1)
        other = self.whole(depth - 1)
        if other.fixed:
            other = self._small(0)
        match self.choices.below(3):
            case 0:
                return Phrase(f"({name} + {other.text})", other.lo, other.hi + 1)
            case 1:
                return Phrase(f"({other.text} + {name})", other.lo, other.hi + 1)
        return Phrase(f"({name} - {other.text})", -other.hi, 1 - other.lo)

    def _compare_real(self, depth: int) -> Phrase:
        other = self.choices.weighted([(3, self.real), (1, self.whole)])(depth - 1)
        order = self.choices.pick(["<", ">", "<=", ">=", "==", "!="])
        return Phrase(f"({self.real(depth - 1).text} {order} {other.text})")

    def _both(self, depth: int) -> Phrase:
        word = self.choices.pick(["and", "or"])
        parts = [self.flag(depth - 1, bare=True).text for _ in range(self.choices.weighted([(4, 2), (1, 3)]))]
        return Phrase("(" + f" {word} ".join(parts) + ")")

    def _not(self, depth: int) -> Phrase:
        return Phrase(f"(not {self.flag(depth - 1, bare=True).text})")

    def _same(self, depth: int) -> Phrase:
        return Phrase(
            f"({self.flag(depth - 1).text} {self.choices.pick(['==', '!='])} {self.flag(depth - 1).text})"
        )

    def _choose_flag(self, depth: int) -> Phrase:
        return Phrase(
            f"({self.flag(depth - 1).text} if {self.flag(depth - 1, bare=True).text} else {self.flag(depth - 1).text})"
        )

    def _quantified(self, depth: int) -> Phrase:
        name = f"w{len(self.locals)}"
        kind, domain = self.domain()
        inner = self.bind(**{name: kind})
        return Phrase(
            f"{self.choices.pick(['any', 'all'])}({inner.flag(depth - 1).text} for {name} in {domain})"
        )

    def _is_element(self, depth: int) -> Phrase:
        left = self._element_value(depth)
        if self.choices.maybe(50):
            return Phrase(f"({left.text} {self.choices.pick(['is', 'is not', 'in'])} {self.group()})")
        return Phrase(f"({left.text} {self.choices.pick(['==', '!='])} {self.element(depth - 1).text})")

    def _is_direction(self, depth: int) -> Phrase | None:
        if not (self.words.of_kind("direction") or self.words.of_kind("vec2")):
            return None
        left = self.runtime_direction(depth)
        sides = [*SIDES, *self._locals("side")]
        return Phrase(
            self.choices.pick(
                [
                    f"({left.text} == {self.choices.pick(sides)})",
                    f"({left.text} is {self.choices.pick(sides)})",
                    f"({left.text} in ({self.choices.pick(sides)}, {self.choices.pick(sides)}))",
                    f"({left.text} != {self.runtime_direction(depth - 1).text})",
                    f"({self.choices.pick(sides)} is {left.text})",
                    f"({left.text} is not {self.runtime_direction(depth - 1).text})",
                ]
            )
        )

    def _flag_there(self, depth: int) -> Phrase | None:
        """`left is CONDITION`: the condition as it is at a neighbor."""
        lets = self.lets("flag")
        inner = (
            self.choices.pick(lets)
            if lets and self.choices.maybe(70)
            else f"({self._compare_whole(depth).text} or {self.flag(0).text})"
        )
        return Phrase(f"({self.place()} is {inner})")

    def domain(self) -> tuple[Kind, str]:
        """What a loop may run over: the kind of its variable, and the text."""
        choices = self.choices
        groups = [
            *self.words.groups,
            f"({choices.pick(self.words.elements)}, {choices.pick(self.words.elements)})",
        ]
        return choices.weighted(
            [
                (
                    4,
                    (
                        SIDE,
                        choices.pick(
                            ["(left, right)", "sides", "diagonals", "(below, above.left)", "octants"]
                        ),
                    ),
                ),
                (3, (NUMBER, choices.pick(["0..2", "0..1"]))),
                (2, (ONE, choices.pick(groups))),
                (1, (PLACE, "(at(0, 2), at(-3, 1))")),
            ]
        )

    # Whole numbers

    def whole(self, depth: int) -> Phrase:
        leaves = [(3, self._small), (6, self._whole_name), (2, self._whole_param), (2, self._loop_number)]
        trees = [
            (4, self._count), (2, self._sum), (3, self._add), (2, self._multiply), (1, self._negate), (1, self._abs),
            (2, self._extreme), (2, self._modulo), (2, self._quotient), (2, self._choose_whole), (1, self._clamp),
        ]  # fmt: skip
        return self._one(leaves + (trees if depth > 0 else []), depth)

    def _small(self, depth: int) -> Phrase:
        value = self.choices.pick([0, 1, 2, 3, -1, 5, 7, -4, 255])
        return Phrase(str(value), value, value, fixed=True)

    def _whole_name(self, depth: int) -> Phrase | None:
        words = self.words
        kinds = {**words.fields, **words.properties, **self.locals}
        names = [name for name, kind in kinds.items() if kind.name == "int"]
        if not names:
            return None
        name = self.choices.pick(names)
        return Phrase(self._seen(name), kinds[name].lo, kinds[name].hi)

    def _whole_param(self, depth: int) -> Phrase | None:
        name = self._param("int")
        return None if name is None else Phrase(name, self.words.params[name].lo, self.words.params[name].hi)

    def _loop_number(self, depth: int) -> Phrase | None:
        names = self._locals("number")
        return Phrase(self.choices.pick(names), 0, 2, fixed=True) if names else None

    def _count(self, depth: int) -> Phrase:
        arguments = [
            self.flag(depth - 1, bare=True).text for _ in range(self.choices.weighted([(4, 1), (1, 2)]))
        ]
        kernel = self.kernel()
        weights = self.words.kernels[kernel or "box"]
        text = ", ".join(arguments) + (f" in {kernel}" if kernel else "")
        return Phrase(f"count({text})", sum(w for w in weights if w < 0), sum(w for w in weights if w > 0))

    def _sum(self, depth: int) -> Phrase | None:
        value = self.whole(depth - 1)
        kernel = self.kernel()
        weights = self.words.kernels[kernel or "box"]
        reach = max(abs(value.lo), abs(value.hi)) * sum(map(abs, weights))
        if value.fixed or reach > LIMIT:
            return None
        return Phrase(f"sum({value.text}{f' in {kernel}' if kernel else ''})", -reach, reach)

    def _add(self, depth: int) -> Phrase | None:
        a, b = self.whole(depth - 1), self.whole(depth - 1)
        reach = max(abs(a.lo), abs(a.hi)) + max(abs(b.lo), abs(b.hi))
        if reach > LIMIT:
            return None
        if self.choices.maybe(40):
            return Phrase(f"({a.text} - {b.text})", a.lo - b.hi, a.hi - b.lo, a.fixed and b.fixed)
        return Phrase(f"({a.text} + {b.text})", a.lo + b.lo, a.hi + b.hi, a.fixed and b.fixed)

    def _multiply(self, depth: int) -> Phrase | None:
        a, b = self.whole(depth - 1), self.whole(depth - 1)
        corners = [x * y for x in (a.lo, a.hi) for y in (b.lo, b.hi)]
        if max(map(abs, corners)) > LIMIT:
            return None
        return Phrase(f"({a.text} * {b.text})", min(corners), max(corners), a.fixed and b.fixed)

    def _negate(self, depth: int) -> Phrase:
        value = self.whole(depth - 1)
        return Phrase(f"(-{value.text})", -value.hi, -value.lo, value.fixed)

    def _abs(self, depth: int) -> Phrase:
        value = self.whole(depth - 1)
        return Phrase(f"abs({value.text})", 0, max(abs(value.lo), abs(value.hi)), value.fixed)

    def _extreme(self, depth: int) -> Phrase:
        a, b = self.whole(depth - 1), self.whole(depth - 1)
        word, pick = self.choices.pick([("min", min), ("max", max)])
        return Phrase(f"{word}({a.text}, {b.text})", pick(a.lo, b.lo), pick(a.hi, b.hi), a.fixed and b.fixed)

    def _clamp(self, depth: int) -> Phrase:
        value = self.whole(depth - 1)
        return Phrase(f"clamp({value.text}, -2, 3)", -2, 3, value.fixed)

    def _modulo(self, depth: int) -> Phrase:
        return whole_phrases.modulo(self, depth)

    def _quotient(self, depth: int) -> Phrase | None:
        return whole_phrases.quotient(self, depth)

    def _choose_whole(self, depth: int) -> Phrase:
        a, b = self.whole(depth - 1), self.whole(depth - 1)
        text = f"({a.text} if {self.flag(depth - 1, bare=True).text} else {b.text})"
        return Phrase(text, min(a.lo, b.lo), max(a.hi, b.hi), a.fixed or b.fixed)

    # Reals and vectors

    def real(self, depth: int) -> Phrase:
        return real_phrases.real(self, depth)

    def vector(self, depth: int) -> Phrase:
        return real_phrases.vector(self, depth)

    # Elements and directions

    def element(self, depth: int) -> Phrase:
        if self.choices.maybe(45):
            return self._element_value(depth)
        return Phrase(self.choices.pick([*self.words.elements, *self._locals("one")]))

    def _element_value(self, depth: int) -> Phrase:
        """An element that hangs on the world."""
        name = self._named("element")
        options = [self.place(), "here"] if name is None else [name, name, self.place(), "here"]
        value = self.choices.pick(options)
        if depth > 0 and self.choices.maybe(20):
            return Phrase(
                f"({value} if {self.flag(depth - 1, bare=True).text} else {self.element(depth - 1).text})"
            )
        return Phrase(value)

    def direction(self, depth: int) -> Phrase:
        if self.choices.maybe(50):
            return self.runtime_direction(depth)
        return Phrase(self.choices.pick([*SIDES, *self._locals("side")]))

    def runtime_direction(self, depth: int) -> Phrase:
        """A direction that depends on the world."""
        if depth > 0 and self.choices.maybe(20):
            return Phrase(f"opposite({self.runtime_direction(depth - 1).text})")
        name = self._named("direction")
        if name is None or (depth > 0 and self.choices.maybe(30)):
            return Phrase(f"octant({self.vector(depth - 1).text})")
        if depth > 0 and self.choices.maybe(20):
            return Phrase(
                f"({name} if {self.flag(depth - 1, bare=True).text} else {self.direction(depth - 1).text})"
            )
        return Phrase(name)
