"""Records of rule files, tasks, scenes and studies: dataclasses whose fields declare keys, and their reader."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import MISSING, dataclass, field, fields, replace
from difflib import get_close_matches
from types import UnionType
from typing import Any, ClassVar, TypeVar, dataclass_transform, get_args, get_origin, get_type_hints

from powderdsl.diagnostics import Reporter, Source, Span, suggest
from powderdsl.diagnostics.printable import look_alikes, shown_character, spell
from powderdsl.syntax.parse import Syntax, parse_scalar
from powderdsl.syntax.yaml_tree import Mapping, Node, Scalar, Sequence, parse_yaml

RECORDS: dict[str, type[Record]] = {}
"""By name: that of the class in lower case, without `Decl`."""


@dataclass_transform(frozen_default=True, kw_only_default=True)
class Record:
    """A mapping in a file, as a frozen dataclass. Fields declared with `keyed` have a key.

    `noun` includes its article. `others` is the noun for further keys, if allowed, whose values are lines and are
    stored in `values`. `prefixes` begin keys that are lines themselves: `for side in (left, right)`.
    """

    NOUN: ClassVar[str] = ""
    OTHERS: ClassVar[str] = ""
    PREFIXES: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls, noun: str = "", others: str = "", prefixes: tuple[str, ...] = ()) -> None:
        cls.NOUN, cls.OTHERS, cls.PREFIXES = noun, others, prefixes or cls.PREFIXES
        RECORDS[cls.__name__.removesuffix("Decl").lower()] = dataclass(frozen=True, kw_only=True)(cls)


class Entry(Record):
    """A record under a key that is its name. Keys of records with a noun are new names."""

    name: Scalar


R = TypeVar("R", bound=Record)
E = TypeVar("E", bound=Entry)


@dataclass(frozen=True)
class Form:
    """The form of a word: a pattern, a noun for such words, the label and the fix for other words, and a reader."""

    pattern: str
    noun: str
    label: str
    fix: str = ""
    """`{}` stands for the key."""
    read: Callable[[str], Any] = str
    code: str = "PD110"


NAME_FORM = Form(
    r"[A-Za-z0-9][A-Za-z0-9_-]{0,59}", "a name", "letters, digits, `-` and `_`, up to 60", code="PD111"
)
"""Names of tasks, scenes and studies, which are also file names."""


@dataclass(frozen=True)
class Key:
    """A key of a record.

    `shape` follows from the field's type unless declared: ``text word words number flag line
    lines invariants record section pairs``. The node of a ``mapping``, ``list``, ``block`` or ``any`` is kept.
    """

    about: str
    """A description for messages, the docs and the JSON Schema, in one line."""
    name: str = ""
    """The key, if it is not the field's name."""
    required: bool = False
    """True if the file must have it. A field without a default is always required."""
    choices: tuple[str, ...] = ()
    bounds: tuple[int, int] = (0, 0)
    """Of a number."""
    form: Form | None = None
    """Of a word."""
    short: bool = False
    """True if an entry that is not a mapping sets this key."""
    maps: str = ""
    """The keys and values of a mapping that is not a record, such as "parameters to values"."""
    shape: str = ""
    field: str = ""
    type: Any = None


def keyed(about: str, default: Any = None, **how: Any) -> Any:
    """A field of a record with a key; see `Key`."""
    return field(default=default, metadata={"key": Key(about, **how)})


_SHAPES: dict[Any, str] = {
    str: "text",
    Scalar: "word",
    int: "number",
    bool: "flag",
    Syntax: "line",
    tuple[Scalar, ...]: "words",
    tuple[Syntax, ...]: "lines",
}
VALUES = ("word", "number", "flag", "line")
"""Shapes of a single value, which cannot be empty."""

_KEYS: dict[type[Record], dict[str, Key]] = {}


def keys_of(kind: type[Record]) -> dict[str, Key]:
    """The keys of a record, its own before inherited ones."""
    if kind in _KEYS:
        return _KEYS[kind]
    hints, keys = get_type_hints(kind), _KEYS.setdefault(kind, {})
    for item in sorted(fields(kind), key=lambda item: item.name not in kind.__annotations__):  # type: ignore[arg-type]  # records are dataclasses
        if "key" not in item.metadata:
            continue
        row: Key = item.metadata["key"]
        hint = hints[item.name]
        if isinstance(hint, UnionType) and len(get_args(hint)) == 2:  # a value or None
            hint = get_args(hint)[0]
        shape = "word" if hint is str and (row.choices or row.form) else _SHAPES.get(hint, "any")
        if shape == "any" and get_origin(hint) is tuple:
            hint = get_args(hint)[0]
            shape = "pairs" if get_origin(hint) is tuple else "section"
        elif shape == "any" and isinstance(hint, type):
            shape = "record"
        required, name = row.required or item.default is MISSING, row.name or item.name
        keys[name] = replace(
            row, name=name, required=required, shape=row.shape or shape, field=item.name, type=hint
        )
    return keys


_MEANT = {
    "rules": "do",
    "rule": "do",
    "steps": "passes",
    "types": "elements",
    "state": "fields",
    "constants": "params",
}
"""Keys that users may expect, and the actual key."""

NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")
MAX_NAME = 40


def first_line(node: Node) -> Span:
    """The first line of a node, for labels: a whole block is too long to underline."""
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


def read_tree(source: Source, reporter: Reporter, start: str) -> Node | None:
    """The located tree of a file, or None after a report. `start` is the expected start of the file."""
    tree = parse_yaml(source, reporter)
    if tree is None and not reporter.has_errors:
        reporter.error("PD107", f"{source.name} is empty", None, helps=[start])
    return tree


Entries = dict[str, tuple[Scalar, Node]]
"""The entries of a mapping by key: the key with its location, and its value."""


class Reader:
    """Reads records from located YAML and reports mistakes."""

    def __init__(self, reporter: Reporter):
        self.reporter = reporter

    # Records

    def record(self, kind: type[R], node: Node, what: str, **known: Any) -> R | None:
        """The record of a mapping; None after a report if a field without a default has no value.

        Other fields that are absent, or wrong and reported, get their defaults.
        """
        return self.build(kind, **known, **self.values(kind, self.mapping(kind, node, what)))

    def build(self, kind: type[R], **values: Any) -> R | None:
        """A record of values by field, unless a field without a default lacks one."""
        for row in keys_of(kind).values():
            if row.required and row.field not in values and not hasattr(kind, row.field):
                return None
        return kind(**values)

    def entry(self, kind: type[E], name: Scalar, node: Node) -> E | None:
        """The record of one entry of a section. Without a mapping it is the value of its `short` key."""
        keys = keys_of(kind)
        for row in keys.values():
            if row.short and not (isinstance(node, Mapping) and len(keys) > 1):
                value = self.value(row, name, node)
                return self.build(kind, name=name, **({} if value is None else {row.field: value}))
        noun = kind.NOUN.split(" ", 1)[-1]
        return self.record(kind, node, f"the {noun} `{name.text}`" if noun else f"`{name.text}`", name=name)

    def entries(self, kind: type[E], node: Node | None) -> Iterator[E]:
        pairs = self.named(node, kind.NOUN) if kind.NOUN else self.pairs(node, "a mapping")
        return (record for name, value in pairs if (record := self.entry(kind, name, value)) is not None)

    def values(self, kind: type[Record], entries: Entries) -> dict[str, Any]:
        """The values of entries by field. Wrong values are reported and left out."""
        keys, values, others = keys_of(kind), {}, []
        for name, (key, node) in entries.items():
            if name in keys:
                value = self.value(keys[name], key, node)
                if value is not None:
                    values[keys[name].field] = value
            elif not name.startswith(kind.PREFIXES) and (line := self.line(node)):
                others.append((key, line))
        return values | {"values": tuple(others)} if kind.OTHERS else values

    def value(self, row: Key, key: Scalar, node: Node) -> Any:
        """The value of a key according to its row, None after a report."""
        about = f"`{key.text}`: {row.about}"
        match row.shape:
            case "words":
                return self.words(node)
            case "lines" | "invariants":
                return self.lines(node, "invariant" if row.shape == "invariants" else "expression")
            case "section":
                return tuple(self.entries(row.type, node))
            case "record":
                known = {"name": key} if issubclass(row.type, Entry) else {}
                return self.record(row.type, node, f"`{key.text}`", **known)
            case "pairs":
                wanted = f"a mapping from {row.maps}"
                pairs = self.pairs(node, wanted, about) if row.maps else self.named(node, "a value")
                read = self.line if row.type == tuple[Scalar, Syntax] else self.single
                return tuple((name, value) for name, part in pairs if (value := read(part)))
            case "mapping" | "list" | "block" | "any":
                return node
        if not isinstance(node, Scalar):
            is_set = row.shape == "line" and isinstance(node, Sequence)
            fix = "a set is written `(a, b)`" if is_set else about
            self.shape(node, f"a single value for `{key.text}`", fix)
            return None
        if row.form is not None:
            return self.read_form(row.form, key.text, node)
        if row.shape == "flag":
            return self.choice(key.text, node, ("yes", "no", "true", "false")) in ("yes", "true")
        if row.choices:
            choice = self.choice(key.text, node, row.choices)
            return int(choice) if choice and row.shape == "number" else choice
        if row.shape == "number":
            number = self.number(key.text, node, *row.bounds)
            return node if row.type is Scalar and number is not None else number
        if row.type is Syntax:
            return self.line(node)
        return " ".join(node.text.split()) if row.type is str else node

    def mapping(self, kind: type[Record], node: Node, what: str) -> Entries:
        """The entries of a mapping by key, unknown keys reported and left out, missing ones reported."""
        known = keys_of(kind)
        if not isinstance(node, Mapping):
            is_loop = isinstance(node, Scalar) and node.text.startswith(kind.PREFIXES)
            fix = "a key ends with `:`" if is_loop else "known keys: " + ", ".join(known)
            self.shape(node, f"a mapping with the keys of {what}", fix)
            return {}
        missing = {name for name, row in known.items() if row.required and node.get(name) is None}
        entries: Entries = {}
        for key, value in node.entries:
            misspelled = get_close_matches(key.text.lower(), sorted(missing), n=1, cutoff=0.7)
            if key.text in known:
                if not self._is_empty(key, value, known[key.text]):
                    entries[key.text] = (key, value)
            elif key.text.startswith(kind.PREFIXES) or (kind.OTHERS and not misspelled):
                entries[key.text] = (key, value)
            else:
                missing -= set(misspelled)  # a misspelled key is one mistake
                self.reporter.error(
                    "PD108", f"unknown key `{key.text}`", key.span, f"not a key of {what}",
                    helps=self._key_help(key.text, kind, what),
                )  # fmt: skip
        for name in sorted(missing):
            start = node.span.start
            self.reporter.error(
                "PD109", f"{what} lacks `{name}`", Span(node.span.source, start, start + 1),
                f"`{name}` is missing", helps=[f"`{name}`: {known[name].about}"],
            )  # fmt: skip
        return entries

    def _is_empty(self, key: Scalar, value: Node, row: Key) -> bool:
        """True after reporting that a key lacks its value, which YAML may have read as a comment."""
        if isinstance(value, Scalar):
            is_empty = value.style == "plain" and not value.text
        else:
            is_empty = row.required and row.shape == "words" and not value.items
        if not is_empty:
            return False
        comment = comment_after(key)
        if row.required or row.shape in VALUES:
            place, label, fix = key.span, "it has no entries", f"`{key.text}`: {row.about}"
            if comment:
                place, label = comment, "a comment, to YAML"
                fix = f'put quotes around it: {key.text}: "{comment.text}"'
            self.reporter.error("PD109", f"`{key.text}` has no value", place, label, helps=[fix])
            return True
        if row.shape == "block" or (row.shape == "text" and comment):
            return False
        self.reporter.report(
            "PD113", f"`{key.text}` is empty", key.span, "it has no entries",
            helps=[f"`{key.text}`: {row.about}", "remove it, or indent its contents"],
        )  # fmt: skip
        return True

    def _key_help(self, word: str, kind: type[Record], what: str) -> tuple[str, ...]:
        """The fix for an unknown key: what it should be called, where it belongs, or that it is a rule."""
        known = keys_of(kind)
        if any(sign in word for sign in ("->", ":=", " swaps ", " moves ", "swap ")):
            return ("YAML reads text before `: ` as a key: quote the rule",)
        if kind.PREFIXES and word == "repeat":
            return ("write a number of repetitions: `repeat 3:`",)
        if kind.PREFIXES and word == "for":
            return ("write a loop variable and its values: `for side in (left, right):`",)
        if _MEANT.get(word) in known:
            return (f"did you mean `{_MEANT[word]}`?",)
        close = suggest(word, known, f"keys of {what}")
        if close and close[0].startswith("did"):
            return close
        for home in RECORDS.values():
            if home.NOUN and home.__module__ == kind.__module__ and word in keys_of(home):
                return (f"`{word}` is a key of {home.NOUN}: check the indentation",)
        return close or ("known keys: " + ", ".join(known),)

    # Values

    def shape(self, node: Node, wanted: str, help_text: str = "") -> None:
        description = {Scalar: "a single value", Sequence: "a list", Mapping: "a mapping"}[type(node)]
        helps = [help_text] if help_text else []
        self.reporter.error(
            "PD107",
            f"expected {wanted}, found {description}",
            first_line(node),
            f"this is {description}",
            helps=helps,
        )

    def line(self, node: Node, start: str = "expression") -> Syntax | None:
        """The syntax of a single line; `start` is the grammar's rule for it."""
        scalar = self.single(node, "one line")
        return parse_scalar(scalar, start, self.reporter) if scalar else None

    def lines(self, node: Node, start: str = "expression") -> tuple[Syntax, ...]:
        """A line, or a list of lines."""
        return tuple(line for item in node.items if (line := self.line(item, start)))

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
        """True if a scalar can be a name. Reports another scalar."""
        word = key.text[:MAX_NAME]
        if NAME.match(key.text) and word == key.text:
            return True
        odd = look_alikes(key.text)
        if odd:
            word, label = spell(word), "it is not plain ASCII"
            helps = ["type these again: " + ", ".join(shown_character(char) for char in odd)]
        else:
            label = "letters, digits and `_`, a letter first"
            clean = re.sub(r"[^A-Za-z0-9_]+", "_", key.text).strip("_")[:MAX_NAME]
            helps = [f"write `{clean}`"] if NAME.match(clean) else []
        self.reporter.error("PD111", f"`{word}` cannot name {what}", key.span, label, helps=helps)
        return False

    def words(self, node: Node) -> tuple[Scalar, ...]:
        """A word or a list of words."""
        if isinstance(node, Scalar) and node.text == "":
            return ()
        return tuple(word for item in node.items if (word := self.single(item, "a word")))

    def single(self, node: Node, wanted: str = "a single value") -> Scalar | None:
        """A node that is a single value; None after reporting another one."""
        if isinstance(node, Scalar):
            return node
        self.shape(node, wanted)
        return None

    def read_form(self, form: Form, key: str, word: Scalar) -> Any:
        """The meaning of a word of a form; None after reporting another word."""
        if re.fullmatch(form.pattern, word.text.strip()):
            return form.read(word.text.strip())
        helps = [form.fix.format(key)] if form.fix else []
        self.reporter.error(
            form.code, f"`{word.text}` is not {form.noun}", word.span, form.label, helps=helps
        )
        return None

    def number(self, key: str, value: Scalar, lo: int, hi: int) -> int | None:
        """A decimal integer within bounds."""
        if not re.fullmatch(r"-?(0|[1-9][0-9]*)", value.text):
            code, problem, label = "PD110", f"`{key}` must be an integer", "not an integer"
        elif len(value.text) > 12 or not lo <= int(value.text) <= hi:
            code, problem, label = "PD402", f"`{key}` must lie in {lo}..{hi}", "out of range"
        else:
            return int(value.text)
        self.reporter.error(code, problem, value.span, label, helps=[f"write a number from {lo} to {hi}"])
        return None

    def choice(self, key: str, value: Scalar, options: tuple[str, ...]) -> str | None:
        if value.text in options:
            return value.text
        message = f"`{key}` must be one of " + ", ".join(f"`{option}`" for option in options)
        helps = suggest(value.text, options, "one of")
        self.reporter.error("PD110", message, value.span, "not one of them", helps=helps)
        return None
