"""PyYAML's parser in Python, for systems without libyaml, such as browsers.

Its scanner rejects `?` in plain scalars inside `[…]` and `{…}`, and tabs between tokens, which libyaml accepts. It
accepts `{key:[value]}`, which libyaml rejects.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

import yaml
from yaml import tokens
from yaml.scanner import ScannerError

_ENDS = "\0 \t\r\n\x85\u2028\u2029"
_SPACES, _BLANKS = re.compile(" *"), re.compile("[ \t]*")
_COMMENT = re.compile("#[^\0\r\n\x85\u2028\u2029]*")


def _plain_scalar(ends: str, after_colon: str) -> re.Pattern[str]:
    """A plain scalar up to the end of its line, or to one of the characters in `ends`, or of others behind a colon."""
    word = f"(?:[^:{ends}{_ENDS}]|:(?![{after_colon}{_ENDS}]))+"
    return re.compile(f"{word}(?:[ \t]+(?!#){word})*")


_PLAIN, _PLAIN_IN_BRACKETS = _plain_scalar("", ""), _plain_scalar(r",\[\]{}", r",?\[\]{}")
_UNEXPECTED = (":,", ":?", ":[", ":]", ":{", ":}")


def events(text: str) -> Iterator[yaml.Event]:
    """The events of a text that has only printable characters. Raises yaml.YAMLError."""
    # libyaml does not count a byte order mark at the start.
    return yaml.parse(text.removeprefix("\ufeff"), Loader=_Loader)


class _Loader(yaml.SafeLoader):
    # The runs below contain no line breaks, so columns grow as indices do.
    def _read(self, pattern: re.Pattern[str]) -> str:
        """The text that matches a pattern here, after moving past it."""
        match = pattern.match(self.buffer, self.pointer)
        text = match[0] if match else ""
        self.pointer += len(text)
        self.index += len(text)
        self.column += len(text)
        return text

    def scan_to_next_token(self) -> None:
        while True:
            self._read(_BLANKS if self.flow_level or not self.allow_simple_key else _SPACES)
            self._read(_COMMENT)
            if not self.scan_line_break():
                return
            if not self.flow_level:
                self.allow_simple_key = True

    def scan_plain(self) -> tokens.ScalarToken:
        pattern = _PLAIN_IN_BRACKETS if self.flow_level else _PLAIN
        start = end = self.get_mark()
        parts: list[str] = []
        breaks: list[str] = []
        while self.peek() != "#" and (words := self._read(pattern)):
            self.allow_simple_key = False
            parts += [*breaks, words]
            end = self.get_mark()
            if self.flow_level and self.prefix(2) in _UNEXPECTED:
                raise ScannerError("while scanning a plain scalar", start, "found unexpected ':'", end)
            self._read(_BLANKS)
            breaks = self.scan_plain_spaces(self.indent + 1, start) or []
            if not breaks or (not self.flow_level and self.column <= self.indent):
                break
        return tokens.ScalarToken("".join(parts), True, start, end)
