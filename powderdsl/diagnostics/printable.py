"""Escaping of text from files and arguments: terminals interpret some characters, and others are invisible.

`PrintableStream` wraps stdout and stderr while a command runs, so that all output is escaped. Code that
draws on the terminal writes to `raw_stream(stream)` and escapes the text in its drawing with `printable` itself.
"""

from __future__ import annotations

import re
import sys
import unicodedata
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TextIO, cast

_CONTROLS = "\x00-\x1f\x7f-\x9f"
"""C0 and C1 control characters, which begin escape sequences or move the cursor."""
_FORMATS = (
    "\u00ad\u0600-\u0605\u061c\u06dd\u070f\u0890\u0891\u08e2\u180e\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff"
    "\ufff9-\ufffb\U000110bd\U000110cd\U00013430-\U0001345f\U0001bca0-\U0001bca3\U0001d173-\U0001d17a"
    "\U000e0000-\U000e0fff"
)
"""Invisible characters: direction marks, joiners, line separators, tags."""
_BLANKS = "\u115f\u1160\u3164\uffa0"
"""Blank letters."""
_SURROGATES = "\ud800-\udfff"
"""Bytes of file names that are not UTF-8."""

_UNPRINTABLE = re.compile(f"[{_CONTROLS}{_FORMATS}{_BLANKS}{_SURROGATES}]")
_STYLE = re.compile(r"(\x1b\[[0-9;]*m)")


def printable(text: str, *, lines: bool = False) -> str:
    """A text with every character that a terminal obeys or does not show as ``\\uXXXX``, as JSON writes it.

    These are control characters (also C1, which some terminals interpret), direction marks, invisible characters, and
    bytes that are not UTF-8. JSON keeps its meaning.

    `lines`: keep line breaks and tabs, which a message of one line must not contain.
    """
    return _UNPRINTABLE.sub(
        lambda match: match[0] if lines and match[0] in "\t\n" else _escaped(match[0]), text
    )


def _escaped(char: str) -> str:
    units = char.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[at : at + 2].hex()}" for at in range(0, len(units), 2))


# Letters that look like other letters


def spell(word: str) -> str:
    """An identifier as a message should print it: letters that only look like ASCII ones as ``\\uXXXX``.

    A word in another script is unchanged; one that mixes ASCII with other scripts, or with other forms of Latin letters
    (full width, mathematical), is escaped.
    """
    odd = set(look_alikes(word))
    return "".join(_escaped(char) if char in odd else char for char in printable(word))


def look_alikes(word: str) -> tuple[str, ...]:
    """The distinct characters of a word that may be confused with others, in order."""
    mixed = any(char.isascii() and char.isalpha() for char in word)
    odd = (
        char
        for char in word
        if not char.isascii()
        and (
            unicodedata.normalize("NFKC", char).isascii()
            or (mixed and char.isalpha() and not unicodedata.name(char, "").startswith("LATIN"))
        )
    )
    return tuple(dict.fromkeys(odd))


def shown_character(char: str) -> str:
    """A character in a message, if it is not ASCII with its name: ``U+0430 CYRILLIC SMALL LETTER A``."""
    if char.isascii():
        return f"`{char}`"
    return f"`{printable(char)}` (U+{ord(char):04X} {unicodedata.name(char, 'without a name')})"


# Streams


class PrintableStream:
    """A text stream that escapes what is written to it. It has no `buffer`, so nothing bypasses it."""

    def __init__(self, stream: TextIO):
        self.unguarded: TextIO = raw_stream(stream)

    def write(self, text: str) -> int:
        self.unguarded.write(printable(text, lines=True))
        return len(text)

    def writelines(self, texts: Iterable[str]) -> None:
        for text in texts:
            self.write(text)

    def __getattr__(self, name: str) -> Any:
        if name in ("buffer", "detach"):
            raise AttributeError(name)
        return getattr(self.unguarded, name)


@contextmanager
def printable_streams() -> Iterator[None]:
    """Escape everything printed inside the block, to stdout and stderr."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (cast(TextIO, PrintableStream(stream)) for stream in before)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before


def raw_stream(stream: Any) -> Any:
    """The stream behind a `PrintableStream`, for code that draws on a terminal; any other stream unchanged."""
    return stream.unguarded if isinstance(stream, PrintableStream) else stream


def write_styled(stream: Any, text: str) -> None:
    """Write a text to any stream, escaped by `printable` except for colors. Text from files must be escaped before."""
    pieces = enumerate(_STYLE.split(text))
    raw_stream(stream).write("".join(text if at % 2 else printable(text, lines=True) for at, text in pieces))
