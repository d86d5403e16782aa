"""Random rule files: valid by construction, nearly always, so that a comparison of backends gets to run them."""

from __future__ import annotations

from dataclasses import dataclass, field

from powderdsl.model.types import DIRECTION, ELEMENT, FLAG, VEC2, Kind
from powderdsl.testing.generators.choices import Choices
from powderdsl.testing.generators.phrases import Phrases
from powderdsl.testing.generators.trees import Tree, write_yaml
from powderdsl.testing.generators.vocabulary import Manner, Words, declare, some_range

MOVER_PLACES = (
    "below",
    "right",
    "left",
    "above",
    "below.left",
    "above.right",
    "at(0, 2)",
    "at(-3, 1)",
    "at(5, 0)",
)
"""Where swaps and moves may go: never here."""

MAX_ROUNDS = 8
"""How often a substep may be unrolled: the oracle is slow."""


def random_ruleset_text(seed: int, manner: Manner | None = None) -> str:
    """The text of a random rule file: the same for the same seed, on every machine."""
    return ruleset_text(Choices.seeded(seed), manner or Manner())


def ruleset_text(choices: Choices, manner: Manner) -> str:
    """The text of a random rule file, by these choices."""
    words, sections = declare(choices, manner)
    passes: dict[str, Tree] = {}
    for i in range(choices.weighted([(3, 1), (3, 2), (2, 3)])):
        passes[f"pass{i}"] = PassMaker(choices, words, manner, i).tree(list(passes))
    return write_yaml({"pack": "random", **sections, "passes": passes})


@dataclass
class PassMaker:
    """Makes the blocks and rules of one pass."""

    choices: Choices
    words: Words
    manner: Manner
    number: int
    names: int = 0
    taken: dict[bool, set[str]] = field(default_factory=dict)
    """Fields that this substep's assignments (False) and effects (True) set already: a second `:=` could clash."""
    proven: bool = True
    """Whether this substep has no policy, so that it must be free of conflicts."""
    steady: bool = False
    """Whether it has a symmetry as well, so that a `:=` must not depend on the orientation."""

    def tree(self, earlier: list[str]) -> Tree:
        """The pass as YAML."""
        tree: dict[str, Tree] = {}
        if earlier and self.choices.maybe(30):
            order = self.choices.pick(["after", "after", "before"])
            options: list[Tree] = [earlier[-1], [earlier[0], "nowhere?"]]
            tree[order] = self.choices.pick(options)
        scratch = {
            self._name("x"): self._scratch_kind()
            for _ in range(self.choices.weighted([(4, 0), (2, 1), (1, 2)]))
        }
        if scratch:
            tree["scratch"] = {name: str(kind) for name, kind in scratch.items()}
        phrases = Phrases(self.choices, self.words, self.manner, scratch, scratch)
        return {**tree, **self.block(phrases, 2, MAX_ROUNDS, None, False)}

    def _name(self, letter: str) -> str:
        self.names += 1
        return f"{letter}{self.number}_{self.names}"

    def _scratch_kind(self) -> Kind:
        kinds = [some_range(self.choices), FLAG, DIRECTION]
        if self.manner.reals:
            kinds += [Kind("real", -50, 50), Kind("vec2", -9, 9)]
        if 0 in self.words.ids:
            kinds.append(ELEMENT)
        return self.choices.pick(kinds)

    # Blocks

    def block(
        self, phrases: Phrases, depth: int, rounds: int, policy: str | None, symmetric: bool
    ) -> dict[str, Tree]:
        """A block; `rounds` says how often it may still be unrolled."""
        choices = self.choices
        tree: dict[str, Tree] = {}
        if policy is None and choices.maybe(40):
            policy = choices.pick(["drop_both", "first_wins", *["overwrite"] * self.manner.overwrites])
            tree["conflicts"] = policy
        if not symmetric and self.manner.symmetry and choices.maybe(15):
            symmetric = True
            tree["symmetry"] = choices.pick(["mirror", "rotations", "all"])
        lets: dict[str, Tree] = {}
        for _ in range(choices.weighted([(4, 0), (3, 1), (1, 2)])):
            name = self._name("v")
            kind = self._let_kind()
            lets[name] = self._let(phrases, kind)
            phrases = phrases.bind(**{name: kind})
        if lets:
            tree["let"] = lets
        header, inner, rounds_inside = self._header(phrases, rounds)
        if depth > 0 and choices.maybe(20):
            body: Tree = [
                self.block(inner, depth - 1, rounds_inside, policy, symmetric)
                for _ in range(choices.integer(1, 2))
            ]
        else:
            rules = self.substep(inner, policy, symmetric)
            body = rules[0] if len(rules) == 1 and choices.maybe(50) else [*rules]
        tree[header] = body
        if depth > 0 and choices.maybe(25):
            if choices.maybe(50):
                tree["then"] = [self.block(phrases, depth - 1, rounds, policy, symmetric)]
            else:
                tree["then"] = [*self.substep(phrases, policy, symmetric)]
        return tree

    def _header(self, phrases: Phrases, rounds: int) -> tuple[str, Phrases, int]:
        """`do`, `for …` or `repeat …`, what is known inside, and how much unrolling is left."""
        choices = self.choices
        form = choices.weighted([(6, "do"), (4, "for"), (1, "repeat")])
        if form == "repeat" and rounds >= 3:
            times = choices.integer(1, 3)
            return f"repeat {times}", phrases, rounds // times
        if form != "for" or rounds < 4:
            return "do", phrases, rounds
        bindings = []
        for _ in range(choices.weighted([(4, 1), (1, 2)]) if rounds >= 8 else 1):
            name = self._name("i")
            kind, domain = phrases.domain()
            bindings.append(f"{name} in {domain}")
            phrases = phrases.bind(**{name: kind})
            rounds //= 4
        return "for " + ", ".join(bindings), phrases, max(rounds, 1)

    def _let_kind(self) -> Kind:
        kinds = [(6, FLAG), (3, some_range(self.choices)), (2, ELEMENT), (2, DIRECTION)]
        if self.manner.reals:
            kinds += [(2, Kind("real")), (2, VEC2)]
        return self.choices.weighted(kinds)

    def _let(self, phrases: Phrases, kind: Kind) -> str:
        """A value of exactly this kind; integers are clamped to their range."""
        if kind.name == "int":
            return phrases.integer(2).clamped(kind.lo, kind.hi).text
        if kind.name == "real":
            more = self.choices.maybe(10)
            return f"({phrases.real(2)} + 0.0 * {phrases.real(1)})" if more else phrases.real(2).text
        if kind.name == "element":
            return phrases.element(1)
        if kind.name == "direction":
            return phrases.runtime_direction(1)
        return phrases.vector(2) if kind.name == "vec2" else phrases.flag(3)

    # Rules

    def substep(self, phrases: Phrases, policy: str | None, symmetric: bool) -> list[str]:
        """The rules of one substep: anything under a policy, else what can be shown to be free of conflicts."""
        choices = self.choices
        self.taken = {False: set(), True: set()}
        self.proven, self.steady = policy is None, policy is None and symmetric
        forms = self.manner.forms
        if policy is not None:
            table = {
                "transform": (4, self._transform), "swap": (4, self._swap), "move": (3, self._move),
                "assign": (3, self._assign), "push": (1, self._push),
            }  # fmt: skip
            rows = [row for name, row in table.items() if name in forms]
            found = [
                choices.weighted(rows)(phrases)
                for _ in range(choices.weighted([(3, 1), (3, 2), (2, 3), (1, 5)]))
            ]
            return [rule for rule in found if rule] or [self._fallback(phrases)]
        rules: list[str | None] = []
        movers = [
            form
            for form in ("transform", "swap", "move")
            if form in forms and not (symmetric and form in ("swap", "move"))
        ]
        if len(movers) == 3 and len(self.words.elements) > 2 and choices.maybe(25):
            rules += self._separate_movers(phrases)
        elif movers and choices.maybe(80):
            rules += {
                "transform": self._exclusive_transforms,
                "swap": self._guarded_swap,
                "move": self._lone_move,
            }[choices.pick(movers)](phrases)
        if "assign" in forms and (not rules or choices.maybe(40)):
            rules += [self._assign(phrases) for _ in range(choices.integer(1, 2))]
        if "push" in forms and choices.maybe(15):
            rules.append(self._push(phrases))
        return [rule for rule in rules if rule] or [self._fallback(phrases)]

    def _fallback(self, phrases: Phrases) -> str:
        """A rule that is valid in any substep."""
        one = self.words.elements[0]
        if "transform" in self.manner.forms:
            return f"{phrases.group()} -> {one}"
        return f"{one} swaps below if below is not {one} and {phrases.flag(1)} and no"

    def _tail(self, phrases: Phrases, word: str = "if", effects: bool = True) -> str:
        """The rest of a rule: a condition, a chance, effects; any of them may be missing."""
        choices = self.choices
        text = f" {word} {phrases.flag(choices.integer(1, 3), bare=True)}" if choices.maybe(80) else ""
        return text + self._chance(phrases) + (self._effects(phrases) if effects else "")

    def _chance(self, phrases: Phrases) -> str:
        if not self.manner.draws or not self.choices.maybe(20):
            return ""
        return f"{self.choices.pick([',', ''])} with chance {phrases.chance(1)}"

    def _effects(self, phrases: Phrases) -> str:
        if "assign" not in self.manner.forms or not self.choices.maybe(25):
            return ""
        updates = [self._update(phrases, effect=True) for _ in range(self.choices.weighted([(3, 1), (1, 2)]))]
        found = [update for update in updates if update]
        return f"{self.choices.pick([',', ''])} then {', '.join(found)}" if found else ""

    def _subject(self, phrases: Phrases) -> str:
        return phrases.group() if self.choices.maybe(60) else phrases.flag(1, bare=True)

    def _mover_place(self, phrases: Phrases) -> str:
        loops = phrases.sides()
        return (
            self.choices.pick(loops) if loops and self.choices.maybe(70) else self.choices.pick(MOVER_PLACES)
        )

    def _transform(self, phrases: Phrases) -> str:
        return f"{self._subject(phrases)} -> {phrases.element(1)}{self._tail(phrases)}"

    def _swap(self, phrases: Phrases) -> str:
        place = self._mover_place(phrases)
        head = f"swap {place}" if self.choices.maybe(40) else f"{self._subject(phrases)} swaps {place}"
        return head + self._tail(phrases)

    def _move(self, phrases: Phrases) -> str:
        place = self._mover_place(phrases)
        leaving = self.choices.pick([*self.words.elements, *phrases.local("one"), place])
        return f"{self._subject(phrases)} moves {place} leaving {leaving}{self._tail(phrases)}"

    def _assign(self, phrases: Phrases) -> str | None:
        update = self._update(phrases, effect=False)
        return update and update + self._tail(phrases, "where", effects=False)

    def _push(self, phrases: Phrases) -> str | None:
        vectors = [
            name for name, kind in {**self.words.fields, **phrases.scratch}.items() if kind.name == "vec2"
        ]
        if not vectors:
            return None
        amount = self.choices.weighted([(2, phrases.integer), (2, phrases.real)])(1)
        return f"push {self.choices.pick(vectors)} by {amount} away from {phrases.flag(1, bare=True)}{self._chance(phrases)}"

    def _update(self, phrases: Phrases, effect: bool) -> str | None:
        """`field := value`, or `+=`, `-=`, here or at a neighbor."""
        choices = self.choices
        taken = self.taken[effect] if self.proven else set()
        kinds = {**self.words.fields, **self.words.properties, **phrases.scratch}
        targets = [
            name
            for name, kind in kinds.items()
            if kind.name != "chance" and (name not in taken or kind.name in ("int", "real", "vec2"))
        ]
        if not targets:
            return None
        name = choices.pick(targets)
        kind = kinds[name]
        numeric = kind.name in ("int", "real", "vec2")
        place = f"{phrases.place()}." if choices.maybe(35) else ""
        if numeric and (choices.maybe(40) or name in taken or self.steady):
            value = phrases.of_kind(Kind(kind.name, -100, 100), 2)
            return f"{place}{name} {choices.pick(['+=', '-='])} {value}"
        if self.steady:
            return None
        taken.add(name)
        if (
            kind.name in ("int", "real") and kind.lo > kind.hi - 3
        ):  # constants out of the range would be errors
            value = phrases.integer(2).clamped(kind.lo, kind.hi).text
        else:
            value = phrases.fitting(kind, choices.integer(0, 2))
        return f"{place}{name} := {value}"

    # Substeps that the checker accepts without a policy

    def _exclusive_transforms(self, phrases: Phrases) -> list[str | None]:
        choices, elements = self.choices, self.words.elements
        match choices.below(3):
            case 0:
                target = choices.pick(elements)
                return [
                    f"{self._subject(phrases)} -> {target}{self._tail(phrases)}"
                    for _ in range(choices.integer(1, 2))
                ]
            case 1:
                subjects = choices.some(elements, 1, 3)
                return [f"{subject} -> {choices.pick(elements)}{self._tail(phrases)}" for subject in subjects]
        return [f"{self._subject(phrases)} -> {choices.pick(elements)}{self._tail(phrases)}"]

    def _guarded_swap(self, phrases: Phrases) -> list[str | None]:
        """One swap whose targets cannot be movers."""
        choices = self.choices
        place = self._mover_place(phrases)
        numbers = [name for name, kind in self.words.properties.items() if kind.name == "int"]
        flags = [*self.words.of_kind("flag"), *phrases.lets("flag")]
        one = choices.pick([*self.words.elements, *phrases.local("one")])
        options = [f"{one} swaps {place} if {place} is not {one}"]
        if numbers:
            name = choices.pick(numbers)
            options.append(
                f"swap {place} if {name} == {phrases.pick(*phrases.local('number'), '1', '2', '4')} > {place}.{name}"
            )
        if flags:
            name = choices.pick(flags)
            options.append(f"swap {place} if {name} and not {place}.{name}")
        group = phrases.group()
        options.append(f"{group} swaps {place} if {place} is not {group}")
        more = f" and {phrases.flag(2)}" if choices.maybe(60) else ""
        return [choices.pick(options) + more + self._chance(phrases) + self._effects(phrases)]

    def _separate_movers(self, phrases: Phrases) -> list[str | None]:
        """A transform beside a swap or a move, of cells that hold different elements."""
        choices = self.choices
        one, two, three = choices.some(self.words.elements, 3, 3)
        place = self._mover_place(phrases)
        left = choices.pick([*self.words.elements, place])
        verb = choices.pick([f"swaps {place}", f"moves {place} leaving {left}"])
        condition = f"{place} is {three} and {phrases.flag(2)}"
        mover = f"{two} {verb} if {condition}{self._chance(phrases)}{self._effects(phrases)}"
        rules: list[str | None] = [f"{one} -> {phrases.element(1)}{self._tail(phrases)}", mover]
        return rules if choices.maybe(50) else rules[::-1]

    def _lone_move(self, phrases: Phrases) -> list[str | None]:
        return [self._move(phrases)]
