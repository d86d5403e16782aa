"""Random rule files: valid by construction, nearly always, so that a comparison of backends gets to run them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial

from powderdsl.model.types import DIRECTION, ELEMENT, FLAG, REAL, VEC2, Kind
from powderdsl.testing.generators.choices import Choices
from powderdsl.testing.generators.grammar import EXPRESSIONS, RULES, WORDS, Production, either
from powderdsl.testing.generators.phrases import Phrase, Phrases, flag_of_a_loop
from powderdsl.testing.generators.trees import Tree, write_yaml
from powderdsl.testing.generators.vocabulary import Manner, Vocabulary, some_range

MAX_ROUNDS = 8
"""How often a substep may be unrolled: the oracle is slow."""

WEIGHTS = {"transform": 4, "swap": 4, "move": 3, "assign": 3, "push": 1}
"""How often a substep with a policy has each form of rule."""

ADDED = {"int": ("integer",), "real": ("real", "real", "integer", "flag", "draw"), "vec2": ("vec2",)}
"""What can be added to fields of numeric kinds."""


def random_ruleset_text(seed: int, manner: Manner | None = None) -> str:
    """The text of a random rule file: the same for the same seed, on every machine."""
    return ruleset_text(Choices.seeded(seed), manner or Manner())


def ruleset_text(choices: Choices, manner: Manner) -> str:
    """The text of a random rule file, by these choices."""
    grammar = {**WORDS, **EXPRESSIONS, **RULES}
    if manner.borders:
        grammar["kernel"] = either("")
    else:
        del grammar["coordinate"], grammar["inside"]
    if not manner.draws:
        grammar["chance clause"] = either("")
    if "assign" not in manner.forms:
        grammar["effects"] = either("")
    words = Vocabulary(choices, manner, Phrases(choices, grammar, {"flag of a loop": flag_of_a_loop}))
    sections = words.sections()
    passes: dict[str, Tree] = {}
    for i in range(choices.weighted([(3, 1), (3, 2), (2, 3)])):
        passes[f"pass{i}"] = PassMaker(choices, words, manner, i).tree(list(passes))
    return write_yaml({"pack": "random", **sections, "passes": passes})


@dataclass
class PassMaker:
    """Makes the blocks and rules of one pass."""

    choices: Choices
    words: Vocabulary
    manner: Manner
    number: int
    names: int = 0
    scratch: dict[str, Kind] = field(default_factory=dict)
    taken: dict[str, set[str]] = field(default_factory=dict)
    """Fields that this substep's updates and effects set already: a second `:=` could clash."""
    is_proven: bool = True
    """Whether this substep has no policy, so that it must be free of conflicts."""
    is_steady: bool = False
    """Whether it has a symmetry as well, so that a `:=` must not depend on the orientation."""

    def tree(self, earlier: list[str]) -> Tree:
        """The pass as YAML."""
        choices = self.choices
        tree: dict[str, Tree] = {}
        if earlier and choices.maybe(30):
            others: list[Tree] = [earlier[-1], [earlier[0], "nowhere?"]]
            tree[choices.pick(["after", "after", "before"])] = choices.pick(others)
        makers = {form: partial(self._update, form) for form in ("update", "effect")}
        phrases = self.words.phrases
        phrases = replace(phrases, makers={**phrases.makers, **makers})
        for _ in range(choices.weighted([(4, 0), (2, 1), (1, 2)])):
            kinds = [some_range(choices), FLAG, DIRECTION, Kind("real", -50, 50), Kind("vec2", -9, 9)]
            kind = choices.pick([*kinds, ELEMENT] if 0 in self.words.ids else kinds)
            name = self._name("x")
            self.scratch[name] = kind
            phrases = phrases.bound(name, f"{kind.name} field", f"{kind.name} name", reach=kind.reach)
        if self.scratch:
            tree["scratch"] = {name: str(kind) for name, kind in self.scratch.items()}
        return {**tree, **self.block(phrases, 2, MAX_ROUNDS, None, False)}

    def _name(self, letter: str) -> str:
        self.names += 1
        return f"{letter}{self.number}_{self.names}"

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
            kind = choices.weighted(
                [(6, FLAG), (3, some_range(choices)), (2, ELEMENT), (2, DIRECTION), (2, REAL), (2, VEC2)]
            )
            value = (
                clamped(phrases, kind) if kind.name == "int" else phrases.draw(f"{kind.name} let value", 2)
            )
            if value is not None:
                name = self._name("v")
                lets[name] = value.text
                phrases = phrases.bound(name, f"{kind.name} name", f"{kind.name} let", reach=kind.reach)
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
            binding, phrases = phrases.looping(self._name("i"))
            bindings.append(binding)
            rounds //= 4
        return "for " + ", ".join(bindings), phrases, max(rounds, 1)

    def substep(self, phrases: Phrases, policy: str | None, symmetric: bool) -> list[str]:
        """The rules of one substep: anything under a policy, else what can be shown to be free of conflicts."""
        choices, forms = self.choices, self.manner.forms
        self.taken = {"update": set(), "effect": set()}
        self.is_proven, self.is_steady = policy is None, policy is None and symmetric
        kinds = []
        if policy is not None:
            rows = [(weight, form) for form, weight in WEIGHTS.items() if form in forms]
            count = choices.weighted([(3, 1), (3, 2), (2, 3), (1, 5)])
            kinds = [choices.weighted(rows) for _ in range(count)]
        else:
            movers = [form for form in ("transform", "swap", "move") if form in forms]
            if symmetric:
                movers = [form for form in movers if form == "transform"]
            if len(movers) == 3 and choices.maybe(25):
                kinds.append("proven movers")
            elif movers and choices.maybe(80):
                kinds.append(f"proven {choices.pick(movers)}")
            if "assign" in forms and (not kinds or choices.maybe(40)):
                kinds += ["assign"] * choices.integer(1, 2)
            if "push" in forms and choices.maybe(15):
                kinds.append("push")
        rules = [rule for kind in kinds if (rule := phrases.draw(kind, choices.integer(1, 3)))]
        fallback = f"fallback {'transform' if 'transform' in forms else 'swap'}"
        texts = [rule.text for rule in rules] or [phrases.text(fallback, 1)]
        return [line for text in texts for line in text.split("\n")]

    def _update(self, form: str, phrases: Phrases, depth: int) -> Phrase | None:
        """`field := value`, or `+=`, `-=`, here or at a neighbor."""
        choices = self.choices
        taken = self.taken[form] if self.is_proven else set()
        kinds = {**self.words.fields, **self.words.properties, **self.scratch}
        targets = [
            name
            for name, kind in kinds.items()
            if kind.name in ADDED or not (kind.name == "chance" or name in taken or self.is_steady)
        ]
        if not targets:
            return None
        name = choices.pick(targets)
        kind = kinds[name]
        target = f"{{place}}.{name}" if choices.maybe(35) else name
        if kind.name in ADDED and (choices.maybe(40) or name in taken or self.is_steady):
            value = choices.pick(ADDED[kind.name])
            return phrases.filled(Production(1, f"{target} {{plus or minus}}= {{{value}}}"), depth)
        taken.add(name)
        if kind.name in ("int", "real") and (choices.maybe(40) or kind.lo > kind.hi - 3):
            number = clamped(phrases, kind)  # a constant out of the range would be an error
            return (
                None if number is None else phrases.filled(Production(1, f"{target} := {number.text}"), depth)
            )
        return phrases.filled(Production(1, f"{target} := {{{kind.name} value}}"), depth)


def clamped(phrases: Phrases, kind: Kind) -> Phrase | None:
    """A number in the range of a kind."""
    number = "real" if kind.hi - kind.lo >= 3 and kind.name == "real" else "integer"
    return phrases.filled(Production(1, f"clamp({{{number}}}, {kind.lo:g}, {kind.hi:g})"), 2)
