"""Files that are open in an editor: their mistakes, and what the editor shows at a place."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from powderdsl.analysis.ledger import trend_text
from powderdsl.compiler import load_with_diagnostics, read, shipped_rules
from powderdsl.diagnostics import CompileError, Diagnostic, Reporter, Source, Span
from powderdsl.editing.cursor import Cursor, cursor_at, keys_at, values_at
from powderdsl.editing.words import Word, definitions, language_words, occurrences
from powderdsl.model.builtins import RESERVED
from powderdsl.model.declarations import PackDecl
from powderdsl.model.reuse import Reuse
from powderdsl.model.schema import NAME
from powderdsl.model.types import Ruleset
from powderdsl.syntax.parse import reserved_words
from powderdsl.syntax.sources import OPEN, read_source, shipped
from powderdsl.syntax.yaml_tree import Node, parse_yaml

if TYPE_CHECKING:
    from powderdsl.experiments.studies.study import Commands

KIND = re.compile(r"^(pack|ruleset|task|study|scenes?):", re.MULTILINE)
PACKS = ("needs", "packs", "without", "provides", "conflicts", "extends", "rules", "rulesets")
"""Keys whose values name packs or rulesets."""


@dataclass
class Rules:
    """The packs last read for a file, their words, and the model of the last text without mistakes."""

    packs: list[PackDecl] = field(default_factory=list)
    model: Ruleset | None = None
    words: dict[str, list[Word]] = field(default_factory=dict)

    def read(self, names: Sequence[str | Path], packs: Sequence[PackDecl] = ()) -> None:
        """Read the packs with some names unless they are known; keep the previous ones if there are none."""
        if packs := packs or read(names, Reporter())[0]:
            self.packs, self.words = [*packs], {}
            for word in (*language_words(), *definitions(packs)):
                self.words.setdefault(word.name, []).append(word)


class Workspace:
    """The open files.

    `beside` names rules to check packs with, in addition to those that they need. `commands` gives the commands that
    steps of studies may call.
    """

    def __init__(self, beside: str = "", commands: Callable[[], Commands] = dict):
        self.beside, self.commands = beside, commands
        self.rules: dict[Path, Rules] = {}
        self.reuse = Reuse()

    def open(self, path: Path, text: str) -> None:
        """Note that a file is open, or that its text has changed."""
        OPEN[path.resolve()] = text

    def close(self, path: Path) -> None:
        """Note that a file was closed."""
        OPEN.pop(path.resolve(), None)
        self.rules.pop(path, None)

    def text(self, path: Path) -> str:
        return OPEN[path.resolve()]

    # Mistakes

    def check(self, path: Path) -> tuple[Diagnostic, ...]:
        """The diagnostics of `powderdsl check --quick --notes` for a file, in all files that it needs.

        Other YAML files, which have none of our first keys, get none.
        """
        if not KIND.search(self.text(path)):
            return ()
        known = self.rules.setdefault(path, Rules())
        names = [name for name in (self.beside, str(path)) if name]
        packs: Sequence[PackDecl] = ()
        try:
            match kind_of(self.text(path)):
                case "task":
                    from powderdsl.tasks.shipped import load_task_with_diagnostics

                    task, remarks = load_task_with_diagnostics(str(path))
                    known.model, names = task.ruleset, [*map(str, task.rules)]
                case "study":
                    from powderdsl.experiments.studies.study import load_study

                    names = []  # a study loads no rules
                    load_study(str(path), self.commands())
                    return ()
                case "scene" | "scenes":
                    from powderdsl.worlds.scene.read import read_scenes

                    reporter = Reporter()
                    read_scenes(Source(str(path), self.text(path)), reporter)
                    return reporter.diagnostics
                case _:
                    known.model, remarks = load_with_diagnostics(*names, reuse=self.reuse)
                    packs = known.model.declared.packs
        except CompileError as error:
            remarks = error.diagnostics
        known.read(names, packs)
        return remarks

    # At a place

    def complete(self, path: Path, offset: int) -> list[Word]:
        """The words that are allowed at a place."""
        beside = sorted(other.stem for other in path.parent.glob("*.yaml") if other != path)
        return completions(self.text(path), offset, self._rules(path), beside)

    def hover(self, path: Path, offset: int) -> tuple[str, Span] | None:
        """The meaning of the word at a place, as Markdown, and its place."""
        return explanation(Source(str(path), self.text(path)), offset, self._rules(path))

    def definition(self, path: Path, offset: int) -> list[Span]:
        """The definitions of the word at a place."""
        cursor = cursor_at(self.text(path), offset)
        places = [word.span for word in self._rules(path).words.get(cursor.word, ()) if word.span is not None]
        if places:
            return places
        packs = {pack.name.text: pack.name.span for pack in self._rules(path).packs}
        return [packs[cursor.word]] if cursor.word in packs else []

    def references(self, path: Path, offset: int) -> list[Span]:
        """The places of the name at a place, in all files that are loaded with this one."""
        cursor, rules = cursor_at(self.text(path), offset), self._rules(path)
        if not any(entry.span is not None for entry in rules.words.get(cursor.word, ())):
            return []
        own = _namespace(cursor)
        places = occurrences(cursor.word, (pack.source for pack in rules.packs))
        return [span for span in places if _namespace(cursor_at(span.source.text, span.start)) == own]

    def rename(self, path: Path, offset: int, name: str) -> list[Span]:
        """The places to rename. Raises ValueError if the new name would change the meaning of rules."""
        spans, rules = self.references(path, offset), self._rules(path)
        if not spans:
            raise ValueError("no file defines this name")
        if not NAME.match(name) or name in RESERVED or name in reserved_words():
            raise ValueError(f"`{name}` cannot be a name")
        if name in rules.words:
            raise ValueError(f"`{name}` is already a name")
        shipped_here = shipped("rules").resolve()
        for span in spans:
            file = Path(span.source.name).resolve()
            if file.parent == shipped_here and file not in OPEN:
                raise ValueError(f"{span.source.name} comes with powderdsl and uses this name")
        return spans

    def outline(self, path: Path) -> Node | None:
        """The sections of a file and their entries; None if it cannot be read."""
        source = read_source(path, Reporter())
        return parse_yaml(source, Reporter()) if source else None

    def _rules(self, path: Path) -> Rules:
        if path not in self.rules:
            self.check(path)
        return self.rules[path]


def kind_of(text: str) -> str:
    """The key that determines the kind of a file; `pack` if there is none yet."""
    match = KIND.search(text)
    return match[1] if match else "pack"


def completions(text: str, offset: int, rules: Rules, beside: Iterable[str]) -> list[Word]:
    """The words that are allowed at a place of a text. `beside` are allowed packs, in addition to shipped ones."""
    cursor, kind = cursor_at(text, offset), kind_of(text)
    if cursor.key is None and (keys := keys_at(cursor.path, kind)):
        return [Word(key, "key", about) for key, about in keys.items()]
    if choices := values_at(cursor.keys, kind):
        return [Word(choice, "value") for choice in choices]
    last = cursor.keys[-1] if cursor.keys else ""
    if last in PACKS:
        return [Word(name, "pack") for name in dict.fromkeys([*beside, *shipped_rules()])]
    words = [entry for entries in rules.words.values() for entry in entries]
    if last in ("tags", "after", "before"):
        wanted = "tag" if last == "tags" else "pass"
        words = [word for word in words if word.kind == wanted]
    elif last == "about":
        words = []
    return [word for word in words if word.kind != "pass" or last != "do"]


def explanation(source: Source, offset: int, rules: Rules) -> tuple[str, Span] | None:
    """The meaning of the word at a place of a text, as Markdown, and its place."""
    text = source.text
    cursor = cursor_at(text, offset)
    if not cursor.word:
        return None
    span = Span(source, cursor.start, cursor.end)
    if cursor.key is None or text[cursor.end : cursor.end + 1] == ":":
        about = keys_at(cursor.path, kind_of(text)).get(cursor.word)
        if about:
            return f"`{cursor.word}`: {about}", span
    parts = [_described(word, rules.model) for word in rules.words.get(cursor.word, ())]
    return ("\n\n".join(parts), span) if parts else None


def _namespace(cursor: Cursor) -> str:
    """The namespace of a word at a place: that of packs, of passes, or of all other names."""
    if cursor.key in PACKS or cursor.keys in (("pack",), ("ruleset",)):
        return "pack"
    is_pass = (cursor.path == ("passes",) and cursor.key is None) or cursor.key in ("after", "before")
    return "pass" if is_pass else "name"


def _described(word: Word, model: Ruleset | None) -> str:
    """A word as Markdown: what it is, where it comes from, and its values."""
    title = f"**{word.kind}** `{word.name}`" + (f" of pack `{word.pack}`" if word.pack else "")
    lines = [title + (f": {word.about}" if word.about else "")]
    elements = model.elements if model else ()
    element = next((element for element in elements if element.name == word.name), None)
    if model is not None and element is not None and word.kind == "element":
        lines.append(f"id {element.id}, color {element.color}")
        lines += filter(None, [trend_text(model, element.id)])
    return "\n\n".join(lines)
