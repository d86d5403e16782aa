"""A cursor in a file: the keys above it, the key of the value that it is in, and its word."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from powderdsl.editing.json_schema import schema

KEY = re.compile(r"""^(?P<indent>\s*(?:-\s+)*)(?P<key>"[^"]*"|[^\s#:"{\[-][^#:]*?):(?=\s|$)""")


@dataclass(frozen=True)
class Cursor:
    """A place in a text. `path` has the keys above it, from the top.

    `key` is the key of the value that it is in, or None for a key. `start` and `end` are the offsets of the word
    around it.
    """

    path: tuple[str, ...]
    key: str | None
    word: str
    start: int
    end: int

    @property
    def keys(self) -> tuple[str, ...]:
        """The keys down to the value at the cursor."""
        return self.path if self.key is None else (*self.path, self.key)


def cursor_at(text: str, offset: int) -> Cursor:
    """The cursor at a character offset."""
    begin = text.rfind("\n", 0, offset) + 1
    end = text.find("\n", offset)
    line = text[begin : end if end >= 0 else len(text)]
    column = offset - begin
    start = column - len(re.split(r"\W", line[:column])[-1])
    stop = column + len(re.split(r"\W", line[column:])[0])
    before = line[:start]
    path, key = _outer(text[:begin].split("\n")[:-1], line, before)
    path, key = _inner(before, path, key)
    return Cursor(path, key, line[start:stop], begin + start, begin + stop)


def _outer(above: list[str], line: str, before: str) -> tuple[tuple[str, ...], str | None]:
    """The path by indentation, and the key of the line if the cursor is behind it."""
    own = KEY.match(line)
    is_item = line.lstrip().startswith("-")
    # The key of a list may be in the column of its dashes.
    limit = len(line) - len(line.lstrip()) + is_item if line.strip() else len(before)
    path: list[str] = []
    for other in reversed(above):
        match = KEY.match(other)
        if match is None or match.end("indent") >= limit:
            continue
        path.append(match["key"].strip('"'))
        limit = match.end("indent")
        if limit == 0:
            break
    path.reverse()
    if own is None and (is_item or before.strip()):  # an item, or a continued value
        return tuple(path[:-1]), path[-1] if path else None
    return tuple(path), own["key"].strip('"') if own and len(before) > own.end("key") else None


def _inner(before: str, path: tuple[str, ...], key: str | None) -> tuple[tuple[str, ...], str | None]:
    """The path through the mappings in braces that are open before the cursor, on its line."""
    opened: list[int] = []
    for at, char in enumerate(before):
        if char == "{":
            opened.append(at)
        elif char == "}" and opened:
            opened.pop()
    for at in opened:
        if key is not None:
            path, key = (*path, key), None
        entry = re.split(r"[{,](?![^\[(]*[\])])", before[at:])[-1]
        match = re.match(r"\s*([^:\s]+):\s", entry + " " if entry.endswith(":") else entry)
        key = match[1].strip('"') if match else None
    return path, key


# Completions at the cursor, by the schema


def parts_at(path: tuple[str, ...], kind: str) -> list[dict[str, Any]]:
    """The schemas of the values below some keys, in a file that starts with the key `kind`."""
    whole = schema()
    parts = [whole["definitions"][{"scenes": "file"}.get(kind, kind)]]
    for key in path:
        parts = [below for part in parts for below in _below(part, key)]
    return [alternative for part in parts for alternative in _alternatives(part)]


def _alternatives(part: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """The schemas that a value may have, including those of list items; references and choices are followed."""
    if "$ref" in part:
        yield from _alternatives(schema()["definitions"][part["$ref"].rpartition("/")[2]])
    for choice in part.get("anyOf", ()):
        yield from _alternatives(choice)
    if "items" in part:
        yield from _alternatives(part["items"])
    if not {"$ref", "anyOf"} & part.keys():
        yield part


def _below(part: dict[str, Any], key: str) -> Iterator[dict[str, Any]]:
    for alternative in _alternatives(part):
        if key in alternative.get("properties", {}):
            yield alternative["properties"][key]
        elif matching := [
            value
            for pattern, value in alternative.get("patternProperties", {}).items()
            if re.match(pattern, key)
        ]:
            yield from matching
        elif isinstance(alternative.get("additionalProperties"), dict):
            yield alternative["additionalProperties"]


def keys_at(path: tuple[str, ...], kind: str) -> dict[str, str]:
    """The keys that are allowed below some keys, with their meanings."""
    keys: dict[str, str] = {}
    for part in parts_at(path, kind):
        keys |= {key: value.get("description", "") for key, value in part.get("properties", {}).items()}
    return keys


def values_at(path: tuple[str, ...], kind: str) -> list[str]:
    """The words that a value must be one of, if any."""
    return [word for part in parts_at(path, kind) for word in part.get("enum", ()) if isinstance(word, str)]
