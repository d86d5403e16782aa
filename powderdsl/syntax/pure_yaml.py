"""libyaml's rules on PyYAML's parser in Python, for systems without libyaml, such as browsers.

PyYAML's own scanner differs from libyaml: it refuses `?` inside `[…]` and tabs between tokens, and has other words for
the same mistakes. The methods below are those that differ, by libyaml 0.2.5; everything else is inherited. They read
runs of characters with regular expressions, which also makes them several times faster than what they replace.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, NoReturn

import yaml
from yaml import tokens
from yaml.parser import Parser, ParserError
from yaml.scanner import Scanner, ScannerError

_BREAKS = "\r\n\x85\u2028\u2029"
_ENDS = "\0 \t" + _BREAKS
_WORD = f"(?:[^:{_ENDS}]|:(?![{_ENDS}]))[^:{_ENDS}]*(?::(?![{_ENDS}])[^:{_ENDS}]*)*"
_FLOW_ENDS = _ENDS + ",\\[\\]{}"
_FLOW_WORD = (
    f"(?:[^:{_FLOW_ENDS}]|:(?![?{_FLOW_ENDS}]))[^:{_FLOW_ENDS}]*(?::(?![?{_FLOW_ENDS}])[^:{_FLOW_ENDS}]*)*"
)
_PLAIN = re.compile(f"{_WORD}(?:[ \t]+(?!#){_WORD})*")
_PLAIN_IN_FLOW = re.compile(f"{_FLOW_WORD}(?:[ \t]+(?!#){_FLOW_WORD})*")
"""A plain scalar up to the end of its line, outside and inside of brackets."""

_BREAK = re.compile(f"\r\n|[{_BREAKS}]")
_SPACES = re.compile(" *")
_BLANKS = re.compile("[ \t]*")
_COMMENT = re.compile(f"#[^\0{_BREAKS}]*")
_LINE = re.compile(f"[^\0{_BREAKS}]*")
_NAME = re.compile("[0-9A-Za-z_-]*")
_DIGITS = re.compile("[0-9]*")
_SINGLE = re.compile(f"(?:[^'{_ENDS}]|'')+")
_DOUBLE = re.compile(f'[^"\\\\{_ENDS}]+')
_URI = re.compile("[0-9A-Za-z_;/?:@&=+$.!~*'()-]+")
_VERBATIM_URI = re.compile("[0-9A-Za-z_;/?:@&=+$.!~*'(),\\[\\]-]+")
_OCTET = re.compile("%[0-9A-Fa-f]{2}")
_HEX = re.compile("[0-9A-Fa-f]*")
_DOCUMENT = re.compile(f"(?:---|\\.\\.\\.)[{_ENDS}]")

_ESCAPES = dict(zip('0abt\tnvfre "/\\N_LP', '\0\a\b\t\t\n\v\f\r\x1b "/\\\x85\xa0\u2028\u2029', strict=True))
_ESCAPE_LENGTHS = {"x": 2, "u": 4, "U": 8}

_WORDS = {
    ("while parsing a block mapping", "expected <block end>"): "did not find expected key",
    ("while parsing a block collection", "expected <block end>"): "did not find expected '-' indicator",
    ("while parsing a flow sequence", "expected"): "did not find expected ',' or ']'",
    ("while parsing a flow mapping", "expected"): "did not find expected ',' or '}'",
    ("while parsing a block node", "expected"): "did not find expected node content",
    ("while parsing a flow node", "expected"): "did not find expected node content",
    (None, "expected '<document start>'"): "did not find expected <document start>",
}
"""What PyYAML's parser says: its context and how it begins, and libyaml's words for it."""


def events(text: str) -> Iterator[yaml.Event]:
    """The events of a text that has only printable characters, as libyaml gives them. Raises yaml.YAMLError."""
    parser = _Parser(text)
    try:
        while parser.check_event():
            event = parser.get_event()
            assert event is not None
            yield event
    except ParserError as error:
        for (context, problem), words in _WORDS.items():
            if error.context == context and str(error.problem).startswith(problem):
                error.problem = words
        raise
    finally:
        parser.dispose()


class _Mark(yaml.Mark):
    """A place in the text. Nothing needs more of it than the index."""

    def __init__(self, index: int):
        self.index = index


class _Scanner(Scanner):
    """PyYAML's scanner over a text in memory. A line is known by the index of its first character."""

    def __init__(self, text: str):
        # libyaml does not count a byte order mark at the start.
        self.text = text.removeprefix("\ufeff") + "\0" * 16
        self.index = self.line = 0
        self.encoding = None
        self.is_ready = False
        super().__init__()

    @property
    def column(self) -> int:
        return self.index - self.line

    def peek(self, index: int = 0) -> str:
        return self.text[self.index + index]

    def prefix(self, length: int = 1) -> str:
        return self.text[self.index : self.index + length]

    def forward(self, length: int = 1) -> None:
        self.index += length

    def get_mark(self) -> _Mark:
        return _Mark(self.index)

    def _read(self, pattern: re.Pattern[str]) -> str:
        """The text that matches a pattern here, after moving past it."""
        found = pattern.match(self.text, self.index)
        if found is None:
            return ""
        self.index = found.end()
        return found[0]

    def _read_break(self) -> str:
        """A line break as the text of a scalar has it, or nothing."""
        found = self._read(_BREAK)
        if found:
            self.line = self.index
        return found if found in ("", "\u2028", "\u2029") else "\n"

    def _at_document(self) -> bool:
        return self.index == self.line and _DOCUMENT.match(self.text, self.index) is not None

    def _fail(self, context: str, start: _Mark, problem: str) -> NoReturn:
        raise ScannerError(context, start, problem, self.get_mark())

    def _ready(self) -> list[tokens.Token]:
        """The tokens that were read and not taken. The first, if there is one, will not change."""
        if not self.is_ready:
            while self.need_more_tokens():
                self.fetch_more_tokens()
            self.is_ready = True
        return self.tokens

    def check_token(self, *choices: Any) -> bool:
        found = self._ready()
        return bool(found) and (not choices or isinstance(found[0], choices))

    def peek_token(self) -> tokens.Token:
        return self._ready()[0]

    def get_token(self) -> tokens.Token:
        token = self._ready().pop(0)
        self.is_ready = False
        self.tokens_taken += 1
        if isinstance(token, tokens.TagToken):
            self._ready()  # what is wrong after a tag comes before what is wrong with it
        return token

    def fetch_stream_end(self) -> None:
        # To libyaml the end of the text is the end of a line, also inside brackets.
        for key in self.possible_simple_keys.values():
            if key.required:
                self._fail("while scanning a simple key", key.mark, "could not find expected ':'")
        super().fetch_stream_end()

    def fetch_flow_collection_end(self, TokenClass: type) -> None:
        super().fetch_flow_collection_end(TokenClass)
        self.flow_level = max(self.flow_level, 0)

    def scan_to_next_token(self) -> None:
        while True:
            if self.index == self.line and self.peek() == "\ufeff":
                self.index += 1
            self._read(_BLANKS if self.flow_level or not self.allow_simple_key else _SPACES)
            self._read(_COMMENT)
            if not self._read_break():
                return
            if not self.flow_level:
                self.allow_simple_key = True

    def _end_line(self, context: str, start: _Mark) -> None:
        """Move past blanks, a comment and a line break."""
        self._read(_BLANKS)
        self._read(_COMMENT)
        if self.peek() not in "\0" + _BREAKS:
            self._fail(context, start, "did not find expected comment or line break")
        self._read_break()

    # Directives, anchors and tags.

    def scan_directive(self) -> tokens.DirectiveToken:
        start = self.get_mark()
        context = "while scanning a directive"
        self.index += 1
        name = self._read(_NAME)
        if not name:
            self._fail(context, start, "could not find expected directive name")
        if self.peek() not in _ENDS:
            self._fail(context, start, "found unexpected non-alphabetical character")
        value: tuple[int, int] | tuple[str, str]
        if name == "YAML":
            value = self._version(start)
        elif name == "TAG":
            value = self._tag_prefix(start)
        else:
            self._fail(context, start, "found unknown directive name")
        end = self.get_mark()
        self._end_line(context, start)
        return tokens.DirectiveToken(name, value, start, end)

    def _version(self, start: _Mark) -> tuple[int, int]:
        self._read(_BLANKS)
        major = self._number(start)
        if self.peek() != ".":
            problem = "did not find expected digit or '.' character"
            self._fail("while scanning a %YAML directive", start, problem)
        self.index += 1
        minor = self._number(start)
        # PyYAML's parser refuses a major version other than one, libyaml also a minor one.
        return (major if minor in (1, 2) else 0), minor

    def _number(self, start: _Mark) -> int:
        digits = self._read(_DIGITS)
        if len(digits) > 9:
            self.index -= len(digits) - 9
            self._fail("while scanning a %YAML directive", start, "found extremely long version number")
        if not digits:
            self._fail("while scanning a %YAML directive", start, "did not find expected version number")
        return int(digits)

    def _tag_prefix(self, start: _Mark) -> tuple[str, str]:
        self._read(_BLANKS)
        if self.peek() != "!":
            self._fail("while scanning a tag directive", start, "did not find expected '!'")
        handle = self._handle()
        if handle != "!" and not handle.endswith("!"):
            self._fail("while parsing a tag directive", start, "did not find expected '!'")
        if not self._read(_BLANKS):
            self._fail("while scanning a %TAG directive", start, "did not find expected whitespace")
        prefix = self._uri("while parsing a %TAG directive", start, _VERBATIM_URI)
        if self.peek() not in _ENDS:
            problem = "did not find expected whitespace or line break"
            self._fail("while scanning a %TAG directive", start, problem)
        return handle, prefix

    def _handle(self) -> str:
        start = self.index
        self.index += 1
        self._read(_NAME)
        self.index += self.peek() == "!"
        return self.text[start : self.index]

    def _uri(self, context: str, start: _Mark, pattern: re.Pattern[str], head: str = "") -> str:
        parts = [head[1:]]
        begin = self.index
        while True:
            if self.peek() == "%":
                parts.append(self._escaped(context, start))
            elif part := self._read(pattern):
                parts.append(part)
            else:
                break
        if self.index == begin and not head:
            self._fail(context, start, "did not find expected tag URI")
        return "".join(parts)

    def _escaped(self, context: str, start: _Mark) -> str:
        """One character of a URI, written with `%`."""
        octets: list[int] = []
        width = 1
        while len(octets) < width:
            found = _OCTET.match(self.text, self.index)
            if found is None:
                self._fail(context, start, "did not find URI escaped octet")
            octet = int(found[0][1:], 16)
            if not octets:
                width = 1 if octet < 0x80 else {0xC: 2, 0xD: 2, 0xE: 3, 0xF: 4}.get(octet >> 4, 0)
                if not width or octet >= 0xF8:
                    self._fail(context, start, "found an incorrect leading UTF-8 octet")
            elif octet & 0xC0 != 0x80:
                self._fail(context, start, "found an incorrect trailing UTF-8 octet")
            octets.append(octet)
            self.index = found.end()
        return bytes(octets).decode(errors="replace")

    def scan_anchor(self, TokenClass: type) -> tokens.Token:
        start = self.get_mark()
        self.index += 1
        name = self._read(_NAME)
        if not name or self.peek() not in _ENDS + "?:,]}%@`":
            kind = "an anchor" if TokenClass is tokens.AnchorToken else "an alias"
            problem = "did not find expected alphabetic or numeric character"
            self._fail(f"while scanning {kind}", start, problem)
        return TokenClass(name, start, self.get_mark())

    def scan_tag(self) -> tokens.TagToken:
        start = self.get_mark()
        handle: str | None
        if self.peek(1) == "<":
            self.index += 2
            handle, suffix = None, self._uri("while parsing a tag", start, _VERBATIM_URI)
            if self.peek() != ">":
                self._fail("while scanning a tag", start, "did not find the expected '>'")
            self.index += 1
        else:
            handle = self._handle()
            if len(handle) > 1 and handle.endswith("!"):
                suffix = self._uri("while parsing a tag", start, _URI)
            else:
                suffix = self._uri("while parsing a tag", start, _URI, handle)
                handle, suffix = ("!", suffix) if suffix else (None, "!")
        if self.peek() not in _ENDS and not (self.flow_level and self.peek() == ","):
            self._fail("while scanning a tag", start, "did not find expected whitespace or line break")
        return tokens.TagToken((handle, suffix), start, self.get_mark())

    # Scalars.

    def scan_block_scalar(self, style: str) -> tokens.ScalarToken:
        context, start = "while scanning a block scalar", self.get_mark()
        self.index += 1
        chomping, increment = "", 0
        for _ in range(2):
            char = self.peek()
            if char in "+-" and not chomping:
                chomping = char
            elif char in "0123456789" and not increment:
                if char == "0":
                    self._fail(context, start, "found an indentation indicator equal to 0")
                increment = int(char)
            else:
                break
            self.index += 1
        self._end_line(context, start)
        indent = max(self.indent, 0) + increment if increment else 0
        indent, trailing, end = self._block_breaks(indent, start)
        parts: list[str] = []
        leading, leading_blank = "", False
        while self.column == indent and self.peek() != "\0":
            trailing_blank = self.peek() in " \t"
            if style == ">" and leading == "\n" and not leading_blank and not trailing_blank:
                leading = "" if trailing else " "
            parts += [leading, *trailing]
            leading_blank = trailing_blank
            parts.append(self._read(_LINE))
            leading = self._read_break()
            indent, trailing, end = self._block_breaks(indent, start)
        if chomping != "-":
            parts.append(leading)
        if chomping == "+":
            parts += trailing
        return tokens.ScalarToken("".join(parts), False, start, end, style)

    def _block_breaks(self, indent: int, start: _Mark) -> tuple[int, list[str], _Mark]:
        """Empty lines, the indentation after them (found here if it is 0), and where the last of them ends."""
        breaks: list[str] = []
        end, deepest = self.get_mark(), 0
        while True:
            spaces = self._read(_SPACES)
            if indent and self.column > indent:
                self.index -= min(self.column - indent, len(spaces))
            deepest = max(deepest, self.column)
            if (not indent or self.column < indent) and self.peek() == "\t":
                problem = "found a tab character where an indentation space is expected"
                self._fail("while scanning a block scalar", start, problem)
            found = self._read_break()
            if not found:
                return indent or max(deepest, self.indent + 1, 1), breaks, end
            breaks.append(found)
            end = self.get_mark()

    def scan_flow_scalar(self, style: str) -> tokens.ScalarToken:
        start = self.get_mark()
        self.index += 1
        parts: list[str] = []
        while True:
            if self._at_document():
                self._fail("while scanning a quoted scalar", start, "found unexpected document indicator")
            if self.peek() == "\0":
                self._fail("while scanning a quoted scalar", start, "found unexpected end of stream")
            if style == "'":
                parts.append(self._read(_SINGLE).replace("''", "'"))
                broken = False
            else:
                broken = self._double(parts, start)
            if self.peek() == style:
                break
            breaks = [""] if broken else []
            while True:
                blanks, found = self._read(_BLANKS), self._read_break()
                if not found:
                    break
                breaks.append(found)
            parts += _folded(breaks) if breaks else [blanks]
        self.index += 1
        return tokens.ScalarToken("".join(parts), False, start, self.get_mark(), style)

    def _double(self, parts: list[str], start: _Mark) -> bool:
        """Read up to a blank, a line break or the closing quote; whether an escaped line break was last."""
        context = "while parsing a quoted scalar"
        while True:
            parts.append(self._read(_DOUBLE))
            if self.peek() != "\\":
                return False
            char = self.peek(1)
            if char in _BREAKS:
                self.index += 1
                self._read_break()
                return True
            if char in _ESCAPES:
                self.index += 2
                parts.append(_ESCAPES[char])
                continue
            length = _ESCAPE_LENGTHS.get(char)
            if length is None:
                self._fail(context, start, "found unknown escape character")
            self.index += 2
            digits = self.prefix(length)
            if _HEX.fullmatch(digits) is None:
                self._fail(context, start, "did not find expected hexdecimal number")
            code = int(digits, 16)
            if 0xD800 <= code <= 0xDFFF or code > 0x10FFFF:
                self._fail(context, start, "found invalid Unicode character escape code")
            parts.append(chr(code))
            self.index += length

    def scan_plain(self) -> tokens.ScalarToken:
        pattern = _PLAIN_IN_FLOW if self.flow_level else _PLAIN
        start = end = self.get_mark()
        parts: list[str] = []
        breaks: list[str] = []
        blanks = ""
        while not (self._at_document() or self.peek() == "#"):
            words = self._read(pattern)
            if words:
                parts += [*(_folded(breaks) if breaks else [blanks]), words]
                breaks = []
                end = self.get_mark()
            if self.flow_level and self.peek() == ":" and self.peek(1) in ",?[]{}":
                self._fail("while scanning a plain scalar", start, "found unexpected ':'")
            before = self.index
            blanks = self._blanks(breaks, start)
            if self.index == before or (not self.flow_level and self.column <= self.indent):
                break
        if breaks:
            self.allow_simple_key = True
        return tokens.ScalarToken("".join(parts), True, start, end, "")

    def _blanks(self, breaks: list[str], start: _Mark) -> str:
        """Move past blanks and line breaks, which are added to `breaks`; returns blanks before the first break."""
        first = ""
        while True:
            if breaks and self.column <= self.indent:
                self._read(_SPACES)
                if self.column <= self.indent and self.peek() == "\t":
                    problem = "found a tab character that violates indentation"
                    self._fail("while scanning a plain scalar", start, problem)
            blanks = self._read(_BLANKS)
            first = first if breaks else blanks
            found = self._read_break()
            if not found:
                return first
            breaks.append(found)


def _folded(breaks: list[str]) -> list[str]:
    """The text of line breaks inside a scalar: one becomes a space, of several the first is left out."""
    first, *others = breaks
    if first != "\n":
        return breaks
    return others or [" "]


class _Parser(_Scanner, Parser):
    """PyYAML's parser. Tokens that libyaml loses are lost here too, so that messages are the same."""

    def __init__(self, text: str):
        _Scanner.__init__(self, text)
        Parser.__init__(self)

    def parse_flow_sequence_entry_mapping_key(self) -> yaml.Event:
        self.get_token()
        if not self.check_token(tokens.ValueToken, tokens.FlowEntryToken, tokens.FlowSequenceEndToken):
            self.states.append(self.parse_flow_sequence_entry_mapping_value)
            return self.parse_flow_node()
        self.state = self.parse_flow_sequence_entry_mapping_value
        return self.process_empty_scalar(self.get_token().end_mark)

    def parse_flow_sequence_entry_mapping_value(self) -> yaml.Event:
        if self.check_token(tokens.ValueToken):
            self.get_token()
            if not self.check_token(tokens.FlowEntryToken, tokens.FlowSequenceEndToken):
                self.states.append(self.parse_flow_sequence_entry_mapping_end)
                return self.parse_flow_node()
        self.state = self.parse_flow_sequence_entry_mapping_end
        return self.process_empty_scalar(self.peek_token().start_mark)

    def parse_flow_mapping_key(self, first: bool = False) -> yaml.Event:
        event = super().parse_flow_mapping_key(first)
        if isinstance(event, yaml.ScalarEvent) and event.style is event.anchor is event.tag is None:
            mark = self.peek_token().start_mark
            event.start_mark = event.end_mark = mark
        return event
