"""Random rule files: valid by construction, nearly always, so that a comparison of backends gets to run them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial

from powderdsl.diagnostics import CompileError
from powderdsl.model.builtins import KERNEL_SHAPES, KERNELS, shaped_kernel
from powderdsl.model.types import CHANCE, DIRECTION, ELEMENT, FLAG, REAL, VEC2, Kind, Ruleset, integer
from powderdsl.testing.generators.cases import Choices
from powderdsl.testing.properties.outcomes import Tree, write_yaml
from tests.fuzz.grammar import (
    EXPRESSIONS,
    RULES,
    WORDS,
    Phrase,
    Phrases,
    Production,
    flag_of_a_loop,
    productions,
    weighted,
)
from tests.semantics.texts import load_text

RANGES = (
    (0, 1), (0, 3), (-2, 2), (0, 7), (-1, 1), (0, 0), (-5, -2), (3, 9), (-128, 127), (0, 127), (-129, 5), (0, 128),
    (0, 255), (0, 256), (-32768, 32767), (0, 65535), (-100000, 100000),
)  # fmt: skip
"""Ranges of integers: small ones that saturate, and the borders of storage types and of the checker's search."""

REALS = ("0", "0.5", "1", "-1", "0.1", "-0.75", "9")
"""Floats as they are written in declarations, if the range allows."""


def _reach(kind: Kind) -> float:
    """The largest magnitude."""
    return max(abs(kind.lo), abs(kind.hi))


@dataclass(frozen=True)
class Manner:
    """Features of a random ruleset. Tests of single properties leave out what would break the property."""

    draws: bool = True
    """Streams of random numbers, and chances."""
    borders: bool = True
    """Anything that knows where the grid ends: `row`, `column`, `inside`, kernels that do not wrap."""
    symmetry: bool = True
    overwrites: bool = True
    """Blocks whose moves may overwrite each other, so that cells get lost or doubled."""
    forms: tuple[str, ...] = ("transform", "swap", "move", "assign", "push")


@dataclass
class Vocabulary:
    """Draws declarations. Their names become phrases; those of values are kept with their kinds."""

    choices: Choices
    manner: Manner
    phrases: Phrases
    elements: list[str] = field(default_factory=list)
    ids: list[int] = field(default_factory=list)
    properties: dict[str, Kind] = field(default_factory=dict)
    fields: dict[str, Kind] = field(default_factory=dict)
    params: dict[str, Kind] = field(default_factory=dict)

    def sections(self) -> dict[str, Tree]:
        """The declarations as sections of a rule file; those without entries are left out."""
        choices = self.choices
        last = -1
        for i in range(weighted(choices, [(2, 1), (4, 2), (3, 3), (3, 4), (1, 6), (1, 9)])):
            self.elements.append(f"e{i}")
            last += weighted(choices, [(12, 1), (2, 2), (1, 5)])
            self.ids.append(last)
            self._bind(f"e{i}", "known element", "element word")
        if choices.maybe(3):
            self.ids[-1] = 255
        tags = [f"t{i}" for i in range(choices.integer(0, 2))]
        for tag in tags:
            self._bind(tag, "set name")
        sections: dict[str, Tree] = {
            "params": {f"q{i}": self._param(f"q{i}") for i in self._numbers(3, 3, 2, 0, 1)},
            "properties": {f"p{i}": self._property(f"p{i}") for i in self._numbers(1, 2, 3, 2, 0, 1)},
            "fields": {f"f{i}": self._field(f"f{i}") for i in self._numbers(1, 2, 3, 3, 2, 0, 0, 1)},
            "streams": self._streams(),
            "kernels": {f"k{i}": self._kernel(f"k{i}") for i in self._numbers(1, 2, 1)},
            "tags": dict.fromkeys(tags, "a tag"),
            "elements": {
                name: self._element(identity, tags)
                for name, identity in zip(self.elements, self.ids, strict=True)
            },
            "sets": {f"s{i}": self._set(f"s{i}") for i in self._numbers(3, 2, 1)},
        }
        if self.manner.borders:  # kernels that every rule file knows do not wrap
            wide = shaped_kernel(choices.pick([*KERNEL_SHAPES]), choices.pick([1, 2, 3, 5]))
            for kernel in (*KERNELS.values(), wide):
                self._bind(f" in {kernel.name}", "kernel", reach=len(kernel.weights))
        return {name: tree for name, tree in sections.items() if tree}

    def _numbers(self, *weights: int) -> range:
        """Numbers of some declarations: how many there are is as likely as its weight, from 0 on."""
        return range(weighted(self.choices, [(weight, count) for count, weight in enumerate(weights)]))

    def _bind(self, name: str, *kinds: str, reach: float = 0) -> None:
        self.phrases = self.phrases.bound(name, *kinds, reach=reach)

    def _param(self, name: str) -> Tree:
        choices = self.choices
        kind = choices.pick([CHANCE, integer(0, 7), FLAG, integer(-300, 300), Kind("real", -10, 10)])
        self.params[name] = kind
        self._bind(name, f"{kind.name} param", reach=_reach(kind))
        value = self._literal(kind)
        is_inferred = kind == FLAG or value.endswith("%")
        return value if is_inferred and choices.maybe(50) else {"type": str(kind), "default": value}

    def _property(self, name: str) -> Tree:
        choices = self.choices
        kind = weighted(choices, [(4, integer(0, 7)), (3, FLAG), (2, CHANCE), (2, some_range(choices))])
        self.properties[name] = kind
        self._bind(name, f"{kind.name} property", f"{kind.name} name", reach=_reach(kind))
        return str(kind) if choices.maybe(30) else {"type": str(kind), "default": self._literal(kind)}

    def _field(self, name: str) -> Tree:
        choices = self.choices
        bound = choices.pick([100, 1, 1000, 2])
        floats = [(3, Kind("real", choices.pick([-bound, 0]), bound)), (3, Kind("vec2", -bound, bound))]
        kind = weighted(choices, [(4, some_range(choices)), (3, FLAG), (2, ELEMENT), (2, DIRECTION), *floats])
        self.fields[name] = kind
        self._bind(name, f"{kind.name} field", f"{kind.name} name", reach=_reach(kind))
        entry: dict[str, Tree] = {"type": str(kind), "at": choices.pick(["element", "place"])}
        if kind == ELEMENT or choices.maybe(40):
            entry["default"] = self._literal(kind)
        holders = self.elements
        if entry["at"] == "element" and choices.maybe(40):
            element = choices.pick(self.elements)
            is_holder = choices.maybe(75)
            entry["of"] = element if is_holder else f"any but {element}"
            holders = [name for name in self.elements if (name == element) == is_holder]
        if choices.maybe(20):
            entry["resets"] = "step"
        elif entry["at"] == "element" and choices.maybe(40):
            entry |= {name: self._literal(kind) for name in choices.some(holders, 0, 3)}
        return entry

    def _streams(self) -> Tree:
        names = [f"r{i}" for i in self._numbers(1, 3, 2)] if self.manner.draws else []
        for name in names:
            self._bind(name, "stream name")
        return (
            [*names]
            if self.choices.maybe(30)
            else {name: {"bits": self.choices.pick(["16", "32"])} for name in names}
        )

    def _kernel(self, name: str) -> Tree:
        choices = self.choices
        wraps = choices.maybe(40) or not self.manner.borders
        if choices.maybe(25):
            kernel = shaped_kernel(choices.pick([*KERNEL_SHAPES]), choices.pick([1, 2, 4]))
            self._bind(f" in {name}", "kernel", reach=len(kernel.weights))
            return {"shape": kernel.name, "edges": "wrap"} if wraps else kernel.name
        height, width = choices.pick([(3, 3), (1, 3), (3, 1), (1, 1), (5, 5), (1, 5), (5, 3)])
        weights = choices.pick([(0, 1), (0, 1, -1, 2, 3, -2)])
        rows = [[choices.pick(weights) for _ in range(width)] for _ in range(height)]
        self._bind(f" in {name}", "kernel", reach=sum(abs(weight) for row in rows for weight in row))
        text: list[Tree] = [" ".join(map(str, row)) for row in rows]
        return {"rows": text, "edges": "wrap"} if wraps else text

    def _element(self, identity: int, tags: Sequence[str]) -> Tree:
        choices = self.choices
        entry: dict[str, Tree] = {"id": str(identity), "color": f"#{identity:02X}80{255 - identity:02X}"}
        if carried := choices.some(tags, 0, 2):
            entry["tags"] = [*carried]
        for name, kind in self.properties.items():
            if choices.maybe(60):
                params = [param for param, other in self.params.items() if other == kind]
                entry[name] = choices.pick(params) if params and choices.maybe(30) else self._literal(kind)
        return entry

    def _set(self, name: str) -> Tree:
        text = self.phrases.text("declared set", 0)
        self._bind(name, "set name")
        return text

    def _literal(self, kind: Kind) -> str:
        """A literal of a kind, extremes included."""
        choices = self.choices
        if kind.name == "int":
            lo, hi = int(kind.lo), int(kind.hi)
            return str(choices.pick([min(max(0, lo), hi), lo, hi, choices.integer(lo, hi)]))
        if kind.name == "real":
            return choices.pick([text for text in REALS if kind.lo <= float(text) <= kind.hi])
        return self.phrases.text(f"{kind.name} literal", 0)


def some_range(choices: Choices) -> Kind:
    """A range of integers."""
    return integer(*choices.pick(RANGES))


MAX_ROUNDS = 8
"""How often a substep may be unrolled: the oracle is slow."""

WEIGHTS = {"transform": 4, "swap": 4, "move": 3, "assign": 3, "push": 1}
"""How often a substep with a policy has each form of rule."""

ADDED = {"int": ("integer",), "real": ("real", "real", "integer", "flag", "draw"), "vec2": ("vec2",)}
"""What can be added to fields of numeric kinds."""


@cache
def random_ruleset(seed: int, manner: Manner | None = None) -> Ruleset | None:
    """The random ruleset of a seed; None if the static checks refuse it."""
    try:
        return load_text(random_ruleset_text(seed, manner), f"seed{seed}.yaml")
    except CompileError:
        return None


def random_ruleset_text(seed: int, manner: Manner | None = None) -> str:
    """The text of a random rule file: the same for the same seed, on every machine."""
    return ruleset_text(Choices.seeded(seed), manner or Manner())


def ruleset_text(choices: Choices, manner: Manner) -> str:
    """The text of a random rule file, by these choices."""
    grammar = {**WORDS, **EXPRESSIONS, **RULES}
    if manner.borders:
        grammar["kernel"] = productions("")
    else:
        del grammar["coordinate"], grammar["inside"]
    if not manner.draws:
        grammar["chance clause"] = productions("")
    if "assign" not in manner.forms:
        grammar["effects"] = productions("")
    words = Vocabulary(choices, manner, Phrases(choices, grammar, {"flag of a loop": flag_of_a_loop}))
    sections = words.sections()
    passes: dict[str, Tree] = {}
    for i in range(weighted(choices, [(3, 1), (3, 2), (2, 3)])):
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
        for _ in range(weighted(choices, [(4, 0), (2, 1), (1, 2)])):
            kinds = [some_range(choices), FLAG, DIRECTION, Kind("real", -50, 50), Kind("vec2", -9, 9)]
            kind = choices.pick([*kinds, ELEMENT] if 0 in self.words.ids else kinds)
            name = self._name("x")
            self.scratch[name] = kind
            phrases = phrases.bound(name, f"{kind.name} field", f"{kind.name} name", reach=_reach(kind))
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
        for _ in range(weighted(choices, [(4, 0), (3, 1), (1, 2)])):
            kind = weighted(
                choices,
                [(6, FLAG), (3, some_range(choices)), (2, ELEMENT), (2, DIRECTION), (2, REAL), (2, VEC2)],
            )
            value = (
                clamped(phrases, kind) if kind.name == "int" else phrases.draw(f"{kind.name} let value", 2)
            )
            if value is not None:
                name = self._name("v")
                lets[name] = value.text
                phrases = phrases.bound(name, f"{kind.name} name", f"{kind.name} let", reach=_reach(kind))
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
        form = weighted(choices, [(6, "do"), (4, "for"), (1, "repeat")])
        if form == "repeat" and rounds >= 3:
            times = choices.integer(1, 3)
            return f"repeat {times}", phrases, rounds // times
        if form != "for" or rounds < 4:
            return "do", phrases, rounds
        bindings = []
        for _ in range(weighted(choices, [(4, 1), (1, 2)]) if rounds >= 8 else 1):
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
            count = weighted(choices, [(3, 1), (3, 2), (2, 3), (1, 5)])
            kinds = [weighted(choices, rows) for _ in range(count)]
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
