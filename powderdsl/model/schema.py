"""The table of keys: what each mapping of a rule file may contain. Shape checks, docs and the JSON Schema use it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from collections.abc import Mapping as Mapping_
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

from powderdsl.diagnostics import Reporter, Span, suggest
from powderdsl.diagnostics.printable import look_alikes, shown_character, spelled
from powderdsl.model.builtins import MAX_SIDE_MULTIPLE
from powderdsl.syntax.ast import Syntax
from powderdsl.syntax.parse import parse_scalar
from powderdsl.syntax.yaml_tree import Mapping, Node, Scalar, Sequence


@dataclass(frozen=True)
class Key:
    """A key: the shape of its value, one line for the docs, and whether it is required.

    Shapes: ``text word words number flag mapping list line lines statements block any``. A word may have to be one of
    some `options`; a number lies within `bounds`.
    """

    shape: str
    about: str
    required: bool = False
    options: tuple[str, ...] = ()
    bounds: tuple[int, int] = (0, 0)


_BLOCK = {
    "let": Key("mapping", "names for values, fixed here, in order, before the rules run"),
    "do": Key("block", "a rule, a list of rules (one substep), or blocks in sequence"),
    "then": Key("block", "what comes after: a rule, a list of rules (one substep), or blocks in sequence"),
    "symmetry": Key(
        "word",
        "`mirror`, `rotations` or `all`: the rules hold in these orientations at once",
        options=("mirror", "rotations", "all"),
    ),
    "conflicts": Key(
        "word",
        "`drop_both`, `first_wins` or `overwrite`: what happens when rules claim one cell",
        options=("drop_both", "first_wins", "overwrite"),
    ),
}

KEYS: dict[str, dict[str, Key]] = {
    "pack": {
        "pack": Key("word", "the pack's name", True),
        "about": Key("text", "what it is, in a sentence"),
        "needs": Key("words", "packs that must be loaded too"),
        "provides": Key("words", "packs that it stands in for, where others need them"),
        "conflicts": Key("words", "packs that must not be loaded too"),
        "tags": Key("mapping", "tags that other packs give to their elements, with a sentence each"),
        "properties": Key("mapping", "numbers that every element has"),
        "fields": Key("mapping", "state that cells carry"),
        "streams": Key("any", "sources of random numbers that rules share by name"),
        "params": Key("mapping", "numbers that users override without editing the file"),
        "side_multiple": Key(
            "number",
            "rows and columns of all worlds are multiples of this number",
            bounds=(1, MAX_SIDE_MULTIPLE),
        ),
        "kernels": Key("mapping", "neighborhoods for `count` and `sum`"),
        "sets": Key("mapping", "names for sets of elements"),
        "elements": Key("mapping", "the pack's elements"),
        "also": Key("mapping", "tags and values for elements of other packs"),
        "passes": Key("mapping", "what happens in a step"),
        "invariants": Key("statements", "what is true of every world, a statement a line"),
        "tests": Key("list", "small worlds, and what becomes of them"),
    },
    "ruleset": {
        "ruleset": Key("word", "the ruleset's name", True),
        "about": Key("text", "what it is, in a sentence"),
        "extends": Key("word", "a ruleset that this one takes over, with all that it says"),
        "packs": Key("words", "the packs it is made of, besides those of the ruleset that it extends"),
        "without": Key("words", "packs of the ruleset that it extends, which are left out"),
        "slots": Key("number", "how many element ids there are, vacant ones included", bounds=(1, 256)),
        "matrix": Key("words", "the channels of `World.matrix()`"),
        "rename": Key("mapping", "other names for what packs define: `pack.word: name`"),
        "params": Key("mapping", "other values for the packs' parameters"),
        "also": Key("mapping", "other tags, values and colors for elements of its packs"),
        "invariants": Key("statements", "what is true of every world, a statement a line"),
    },
    "property": {
        "type": Key("line", "its kind", True),
        "default": Key("line", "the value of elements that do not say"),
        "about": Key("text", "what it is, in a sentence"),
    },
    "field": {
        "type": Key("line", "its kind", True),
        "at": Key(
            "word", "`element`: it travels with it; `place`: it stays", True, options=("element", "place")
        ),
        "default": Key("line", "its value in a fresh cell; that of one element beside it, by its name"),
        "of": Key("line", "the elements that have it; others read the default"),
        "resets": Key("word", "`step`: back to the default when a step starts", options=("step",)),
        "tint": Key("mapping", "how it tints cells in pictures, if it is a vector"),
        "about": Key("text", "what it is, in a sentence"),
    },
    "tint": {
        "to": Key("word", 'the color that cells are tinted toward, quoted: "#RRGGBB"', True),
        "full": Key("number", "the length at which a cell would have that color", True, bounds=(1, 1000)),
        "most": Key(
            "line", "the most of that color that a cell can have, such as `50%`; all of it by default"
        ),
    },
    "stream": {
        "bits": Key("number", "resolution of a draw: 16 or 32", bounds=(16, 32)),
        "about": Key("text", "what it is for"),
    },
    "param": {
        "type": Key("line", "its kind", True),
        "default": Key("line", "its value unless the user says otherwise", True),
        "about": Key("text", "what it does, in a sentence"),
    },
    "kernel": {
        "rows": Key("words", "rows of integer weights, an odd number of each, at most 31"),
        "shape": Key("line", "instead of rows: a shape and its radius, `disc(3)`"),
        "edges": Key(
            "word",
            "`nothing` (the default) or `wrap`: what lies outside the grid",
            options=("nothing", "wrap"),
        ),
    },
    "element": {
        "id": Key("number", "the number it asks for, 0 to 255; a free one otherwise", bounds=(0, 255)),
        "color": Key("word", 'its color, quoted: "#RRGGBB"', True),
        "color_by": Key("mapping", "how its color follows a field"),
        "glyph": Key("word", "one character for ASCII art; the first free letter of its name otherwise"),
        "about": Key("text", "what it is, in a sentence"),
        "tags": Key("words", "the tags it carries"),
        "override": Key("flag", "yes: replaces an element of another pack"),
    },
    "also": {
        "tags": Key("words", "tags to add"),
        "color": Key("word", 'another color, quoted: "#RRGGBB"'),
        "color_by": Key("mapping", "how its color follows a field"),
    },
    "color_by": {
        "field": Key("word", "the field that the color follows", True),
        "from": Key("word", "the color at the low end of the range, quoted; the element's own by default"),
        "to": Key("word", 'the color at the high end of the range, quoted: "#RRGGBB"', True),
        "over": Key("line", "the range, LOW..HIGH; all values of the field by default"),
    },
    "pass": {
        "about": Key("text", "what it does, in a sentence"),
        "after": Key("words", "passes that come before it"),
        "before": Key("words", "passes that come after it"),
        "override": Key("flag", "yes: replaces a pass of another pack, in its place"),
        "scratch": Key("mapping", "fields of this pass alone, which start at their default: a kind each"),
        **_BLOCK,
    },
    "block": _BLOCK,
    "test": {
        "given": Key("text", "the start world, in ASCII"),
        "legend": Key("mapping", "what the characters mean, where glyphs will not do"),
        "fields": Key("mapping", "values of fields in the start world, a word a cell; `.` is the default"),
        "after": Key("text", "how many steps it runs: `50 steps`"),
        "expect": Key("text", "what the world looks like then; `?` matches anything"),
        "expect_fields": Key("mapping", "values of fields then; `?` matches anything, `LOW..HIGH` a range"),
        "always": Key("any", "conditions that hold in every cell after every step"),
        "often": Key("any", "how likely cells become something else: `egg -> hen: 2%`"),
        "seed": Key("number", "the seed; several are tried without one", bounds=(0, 2**31 - 1)),
    },
}

OPEN = {
    "element": "a property or field",
    "also": "a property or field",
    "property": "an element",
    "field": "an element",
}
"""Mappings that take further keys, and what these keys name."""

VALUES = ("word", "number", "flag", "line")

SECTIONS = ("text", "mapping", "words", "list", "statements", "any")
"""Shapes without an empty value."""

PREFIXES = {"pass": ("for ", "repeat "), "block": ("for ", "repeat ")}
"""Keys that are read as lines: `for side in (left, right)`, `repeat 2`."""

_MEANT = {
    "rules": "do",
    "rule": "do",
    "steps": "passes",
    "types": "elements",
    "state": "fields",
    "constants": "params",
}
"""Keys that people expect, and what they are called here."""

HOMES = ("pack", "pass", "element", "task", "agent", "reward", "split", "color_by", "tint")
"""Mappings to which a key may belong that stands in another one."""

NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")
MAX_NAME = 40


def first_line(node: Node) -> Span:
    """The first line of a node: underlining a whole block helps nobody."""
    span = node.span
    end = span.source.text.find("\n", span.start)
    return Span(span.source, span.start, max(min(span.end, end if end >= 0 else span.end), span.start + 1))


def comment_after(scalar: Scalar) -> Span | None:
    """The comment that YAML sees after a key or a value on its line."""
    text, start = scalar.span.source.text, scalar.span.end
    end = text.find("\n", start)
    rest = text[start : end if end >= 0 else len(text)]
    if not rest.lstrip(": \t").startswith("#"):
        return None
    return Span(scalar.span.source, start + rest.index("#"), start + len(rest.rstrip()))


Entries = dict[str, tuple[Scalar, Node]]
"""The entries of a mapping by key: the key with its location, and its value."""


class Reader:
    """Reads located YAML by a table of keys, reporting what does not fit."""

    def __init__(self, reporter: Reporter, keys: Mapping_[str, dict[str, Key]] = KEYS):
        self.reporter = reporter
        self.keys = keys

    def shape(self, node: Node, wanted: str, help_text: str = "") -> None:
        """Report a node of the wrong shape."""
        found = {Scalar: "a single value", Sequence: "a list", Mapping: "a mapping"}[type(node)]
        helps = [help_text] if help_text else []
        self.reporter.error(
            "PD107", f"expected {wanted}, found {found}", first_line(node), f"this is {found}", helps=helps
        )

    def read(self, node: Node, context: str, what: str) -> dict[str, Any]:
        """The values of a mapping by key. What is absent, or wrong and reported, is left out."""
        return self.values(self.mapping(node, context, what), context)

    def values(self, entries: Entries, context: str) -> dict[str, Any]:
        """The values of entries, each read as the table says; entries with open keys are under `values`."""
        table = self.keys[context]
        found = {key: self._value(entries, key, table[key]) for key in entries if key in table}
        if context in OPEN:
            others = [entry for key, entry in entries.items() if key not in table]
            found["values"] = tuple((key, line) for key, node in others if (line := self.line(node)))
        return {key: value for key, value in found.items() if value is not None}

    def _value(self, entries: Entries, key: str, row: Key) -> Any:
        node = entries[key][1]
        match row.shape:
            case "text":
                return self.text(entries, key)
            case "word":
                return self.choice(entries, key, row.options) if row.options else self.scalar(entries, key)
            case "words":
                return self.words(node)
            case "number":
                return self.number(entries, key, *row.bounds)
            case "flag":
                return self.choice(entries, key, ("yes", "no", "true", "false")) in ("yes", "true")
            case "line":
                return self.line(node) if isinstance(node, Scalar) else None
            case "statements":
                return self.lines(node, "invariant")
        return node

    def line(self, node: Node, start: str = "expression") -> Syntax | None:
        """The syntax of a single line; `start` is the grammar's rule for it."""
        if isinstance(node, Scalar):
            return parse_scalar(node, start, self.reporter)
        self.shape(node, "one line")
        return None

    def lines(self, node: Node | None, start: str = "expression") -> tuple[Syntax, ...]:
        """A line, or a list of lines."""
        items = () if node is None else node.items if isinstance(node, Sequence) else (node,)
        return tuple(line for item in items if (line := self.line(item, start)))

    def mapping(self, node: Node, context: str, what: str) -> Entries:
        """The entries of a mapping by key, unknown keys reported and left out, missing ones reported."""
        known = self.keys[context]
        prefixes = PREFIXES.get(context, ())
        if not isinstance(node, Mapping):
            fix = "known keys: " + ", ".join(known)
            if isinstance(node, Scalar) and node.text.startswith(prefixes):
                fix = "a key ends with `:`"
            self.shape(node, f"a mapping with the keys of {what}", fix)
            return {}
        missing = {name for name, row in known.items() if row.required and node.get(name) is None}
        entries: Entries = {}
        for key, value in node.entries:
            row = known.get(key.text)
            misspelled = get_close_matches(key.text.lower(), sorted(missing), n=1, cutoff=0.7)
            if row is not None:
                if not self._is_empty(key, value, row):
                    entries[key.text] = (key, value)
                    self._check_shape(row, key, value)
            elif key.text.startswith(prefixes) or (context in OPEN and not misspelled):
                entries[key.text] = (key, value)
            else:
                missing -= set(misspelled)  # a key that is there under a wrong name is one mistake
                self.reporter.error(
                    "PD108", f"unknown key `{key.text}`", key.span, f"not a key of {what}",
                    helps=self._key_help(key.text, context, what),
                )  # fmt: skip
        for name in sorted(missing):
            start = node.span.start
            self.reporter.error(
                "PD109", f"{what} lacks `{name}`", Span(node.span.source, start, start + 1),
                f"`{name}` is missing", helps=[f"`{name}`: {known[name].about}"],
            )  # fmt: skip
        return entries

    def _is_empty(self, key: Scalar, value: Node, row: Key) -> bool:
        """Report a key that lacks its value, which YAML may take for a comment. Returns whether it does."""
        if not isinstance(value, Scalar) or value.style != "plain" or value.text:
            return False
        comment = comment_after(key)
        if row.required or row.shape in VALUES:
            place, label, fix = key.span, "it has no entries", f"`{key.text}`: {row.about}"
            if comment:
                place, label = comment, "a comment, to YAML"
                fix = f'put quotes around it: {key.text}: "{comment.text}"'
            self.reporter.error("PD109", f"`{key.text}` has no value", place, label, helps=[fix])
            return True
        if row.shape not in SECTIONS or (row.shape == "text" and comment):
            return False
        self.reporter.report(
            "PD113", f"`{key.text}` is empty", key.span, "it has no entries",
            helps=[f"`{key.text}`: {row.about}", "remove it, or indent what belongs to it"],
        )  # fmt: skip
        return True

    def _key_help(self, word: str, context: str, what: str) -> tuple[str, ...]:
        """The fix for an unknown key: what it should be called, where it belongs, or that it is a rule."""
        if any(sign in word for sign in ("->", ":=", " swaps ", " moves ", "swap ")):
            return ("YAML takes text before `: ` for a key: quote the rule",)
        if context in PREFIXES and word == "repeat":
            return ("say how often: `repeat 3:`",)
        if context in PREFIXES and word == "for":
            return ("say over what: `for side in (left, right):`",)
        if word in _MEANT and _MEANT[word] in self.keys[context]:
            return (f"did you mean `{_MEANT[word]}`?",)
        close = suggest(word, self.keys[context], f"keys of {what}")
        if close and close[0].startswith("did"):
            return close
        homes = [home for home in HOMES if home != context and word in self.keys.get(home, {})]
        if homes:
            article = "an" if homes[0] in ("element", "agent") else "a"
            return (f"`{word}` is a key of {article} {homes[0]}: check the indentation",)
        return close or ("known keys: " + ", ".join(self.keys[context]),)

    def _check_shape(self, row: Key, key: Scalar, value: Node) -> None:
        if row.shape in ("text", *VALUES) and not isinstance(value, Scalar):
            is_set = row.shape == "line" and isinstance(value, Sequence)
            fix = "a set is written `(a, b)`" if is_set else f"`{key.text}`: {row.about}"
            self.shape(value, f"a single value for `{key.text}`", fix)

    def named(self, node: Node | None, what: str) -> Iterator[tuple[Scalar, Node]]:
        """Entries of a mapping whose keys are new names; bad names are reported and left out."""
        if isinstance(node, Scalar) and node.text == "":
            return
        wanted = f"a mapping with an entry for each {what.split(' ', 1)[-1]}"
        for key, value in self.pairs(node, wanted, "write `NAME: …`, each on its own line"):
            if self.name(key, what):
                yield key, value

    def pairs(self, node: Node | None, wanted: str, help_text: str = "") -> tuple[tuple[Scalar, Node], ...]:
        """Entries of a mapping; none for None, or after reporting another shape."""
        if isinstance(node, Mapping):
            return node.entries
        if node is not None:
            self.shape(node, wanted, help_text)
        return ()

    def name(self, key: Scalar, what: str) -> bool:
        """Whether a scalar can be a name; reports if not."""
        word = key.text[:MAX_NAME]
        if NAME.match(key.text) and word == key.text:
            return True
        odd = look_alikes(key.text)
        if odd:
            word, label = spelled(word), "not all of it is plain ASCII"
            helps = ["type these again: " + ", ".join(shown_character(char) for char in odd)]
        else:
            label = "letters, digits and `_`, a letter first"
            clean = re.sub(r"[^A-Za-z0-9_]+", "_", key.text).strip("_")[:MAX_NAME]
            helps = [f"write `{clean}`"] if NAME.match(clean) else []
        self.reporter.error("PD111", f"`{word}` cannot name {what}", key.span, label, helps=helps)
        return False

    def words(self, node: Node | None) -> tuple[Scalar, ...]:
        """A word or a list of words."""
        if node is None or (isinstance(node, Scalar) and node.text == ""):
            return ()
        if isinstance(node, Mapping):
            self.shape(node, "a word or a list of words")
            return ()
        items = node.items if isinstance(node, Sequence) else (node,)
        for item in items:
            if not isinstance(item, Scalar):
                self.shape(item, "a word")
        return tuple(item for item in items if isinstance(item, Scalar))

    def scalar(self, entries: Entries, key: str) -> Scalar | None:
        value = entries.get(key, (None, None))[1]
        return value if isinstance(value, Scalar) else None

    def text(self, entries: Entries, key: str) -> str:
        value = self.scalar(entries, key)
        return " ".join(value.text.split()) if value else ""

    def number(self, entries: Entries, key: str, lo: int, hi: int) -> int | None:
        """A decimal integer within bounds."""
        value = self.scalar(entries, key)
        if value is None:
            return None
        if not re.fullmatch(r"-?(0|[1-9][0-9]*)", value.text):
            code, problem, label = "PD110", f"`{key}` must be an integer", "not an integer"
        elif len(value.text) > 12 or not lo <= int(value.text) <= hi:
            code, problem, label = "PD402", f"`{key}` must lie in {lo}..{hi}", "out of range"
        else:
            return int(value.text)
        self.reporter.error(code, problem, value.span, label, helps=[f"write a number from {lo} to {hi}"])
        return None

    def choice(self, entries: Entries, key: str, options: tuple[str, ...]) -> str | None:
        value = self.scalar(entries, key)
        if value is None or value.text in options:
            return value.text if value else None
        message = f"`{key}` must be one of " + ", ".join(f"`{option}`" for option in options)
        helps = suggest(value.text, options, "one of")
        self.reporter.error("PD110", message, value.span, "not one of them", helps=helps)
        return None
