"""What a syntax error most likely meant: words for what could follow, and the cure for common slips."""

from __future__ import annotations

import re
from collections.abc import Set
from difflib import get_close_matches

TERMINAL_WORDS = {
    "NAME": "a name",
    "INTEGER": "a whole number",
    "DECIMAL": "a number",
    "PERCENT": "a percentage",
    "UPDATE": "`:=`",
    "COMPARE": "a comparison",
    "LPAR": "`(`",
    "RPAR": "`)`",
    "COMMA": "`,`",
    "DOT": "`.`",
    "PLUS": "`+`",
    "MINUS": "`-`",
    "STAR": "`*`",
    "SLASH": "`/`",
    "QMARK": "`?`",
    "__ANON_0": "`->`",
    "__ANON_1": "`..`",
    "$END": "the end of the line",
}
"""What each terminal is called in messages; keywords, which are missing here, are called by themselves."""

_VALUE_STARTS = {"NAME", "INTEGER", "LPAR"}
_VALUES = {
    "NAME",
    "INTEGER",
    "DECIMAL",
    "PERCENT",
    "YES",
    "NO",
    "TRUE",
    "FALSE",
    "LPAR",
    "CHANCE",
    "ANY",
    "ALL",
    "MINUS",
    "NOT",
}
_OPERATORS = {"PLUS", "MINUS", "STAR", "SLASH", "MOD", "COMPARE", "IS", "IN", "NOT", "__ANON_1"}

_PAIRS = {
    "=>": "write `->`",
    "=<": "write `<=`",
    "=!": "write `!=`",
    "&&": "write `and`",
    "||": "write `or`",
}
_CHARACTERS = {
    "=": "compare with `==`, ask for an element with `is`, assign with `:=`",
    "&": "write `and`",
    "|": "write `or`",
    "!": "write `not`, or `!=` between two values",
    "{": "write rules without braces",
    "}": "write rules without braces",
    "[": "a set is written `(a, b)`",
    "]": "a set is written `(a, b)`",
    "→": "write `->`",
    "≥": "write `>=`",
    "≤": "write `<=`",
    "≠": "write `!=`",
    "×": "write `*`",
    "−": "write `-`",
    '"': "names stand without quotes",
    "'": "names stand without quotes",
    "“": "names stand without quotes",
    ":": "assign with `:=`",
    ";": "one line is one rule: put the next one on a line of its own",
    "%": "a percentage is a number and `%`, without a blank; the remainder of a division is `mod`",
    "^": "powers are written out: `x * x`",
    "#": "a comment needs a blank before its `#`",
}
_WORDS = {
    "when": "if",
    "where": "if",
    "while": "if",
    "provided": "if",
    "unless": "if not",
    "becomes": "->",
    "become": "->",
    "into": "->",
    "to": "->",
    "turns": "->",
    "equals": "==",
    "chance": "with chance",
    "probability": "with chance",
    "but": "and not",
    "swap": "swaps",
    "move": "moves",
    "leaves": "leaving",
    "than": ", then",
    "else": "a if b else c",
}
"""Words that people write, and what the language says instead."""

CUT = "inside `{…}` and `[…]` YAML ends a value at a comma: quote it, or give it a line of its own"


def character_help(text: str, position: int, begin: int) -> str:
    """The cure for a character that no rule contains, or an empty string. The line starts at `begin`."""
    before = text[begin:position]
    asks = re.search(r"\b(if|where|chance)\b", before) is not None
    if text[position] == "=" and text[position : position + 2] == "=>" and asks:
        return "write `>=`"
    if text[position] == "=" and re.fullmatch(r"(.*\bthen)?\s*[\w.?]+\s*", before, re.DOTALL) and not asks:
        return _PAIRS.get(text[position : position + 2], "assign with `:=`")
    if text[position] == "=" and asks:
        return _PAIRS.get(text[position : position + 2], "compare with `==`, ask for an element with `is`")
    return _PAIRS.get(text[position : position + 2]) or _CHARACTERS.get(text[position], "")


def was_cut(text: str, begin: int, end: int) -> bool:
    """Whether a comma of YAML's `{…}` or `[…]` stands right before or after the line."""
    return (
        text[end : end + 64].lstrip(" ")[:1] == ","
        or text[max(begin - 64, 0) : begin].rstrip(" ")[-1:] == ","
    )


def token_help(token: str, accepted: Set[str], before: str, cut: bool) -> str:
    """The cure for a word that cannot stand where it does. `token` is empty at the end of the line.

    `accepted` are the terminals that could follow, `before` is the line up to the error.
    """
    assigns = any(sign in before for sign in (":=", "+=", "-="))
    if (cut and not token) or (cut and not before.strip()):
        return CUT
    if re.search(r"\n\s*-\s", before):
        return "an item of a list starts with `- `: this one, or the one before it, lacks it"
    if token in (":=", "+=", "-="):
        return "only a field of this cell, or of a neighbour, can be assigned"
    if "ELSE" in accepted and re.search(r"\bthen\b", before):
        return "a choice has two sides: `VALUE if CONDITION else VALUE`"
    if "ELSE" in accepted and assigns and not token:
        return "an assignment says `where`: `field := value where condition`"
    if token == "if" and "WHERE" in accepted:
        return "an assignment says `where`: `field := value where condition`"
    if token == "if" and "LEAVING" in accepted:
        return "a move says what it leaves behind: `SET moves below leaving ELEMENT if …`"
    if token == "if" and not before.strip():
        return "a rule says first what happens: `this -> that if …`"
    if token == "where":
        return "only assignments say `where`; this rule says `if`"
    if token == "in" and before.rstrip().endswith(" is"):
        return "say `is` or `in`, not both"
    if token == ")" and before.count("(") <= before.count(")"):
        return "no `(` is open: remove it"
    if not token and before.count("(") > before.count(")"):
        return "write the missing `)`"
    if token == "if" and "__ANON_0" in accepted:
        return "say what happens before the `if`: `SET -> ELEMENT if …`"
    shape = re.search(r"\b(box|ring|disc|diamond|cross|plus)\s*\Z", before)
    if shape and token.isdigit():
        return f"write `{shape[1]}({token})`"
    if token == "/" and before.endswith("/"):
        return "whole division, rounded down, is `div`: `a div b`"
    if token == "->" and "->" in before:
        return "one line is one rule: put the next one on a line of its own"
    if token.endswith("%") and ("CHANCE" in accepted or before.rstrip().endswith("chance")):
        return f"write `with chance {token}`"
    if "THEN" in accepted and before.rstrip().endswith(","):
        return "one line is one rule; effects follow `then`: `…, then field := value`"
    keywords = {name.lower() for name in accepted if name.isalpha() and name not in TERMINAL_WORDS}
    instead = _WORDS.get(token.lower(), "")
    if instead and token != instead:
        return f"write `{instead}`"
    close = get_close_matches(token.lower(), sorted(keywords - {token}), n=1, cutoff=0.7)
    return f"did you mean `{close[0]}`?" if close else ""


def expected_words(accepted: Set[str]) -> str:
    """What could have followed, in words."""
    words = set()
    rest = set(accepted)
    if _VALUE_STARTS <= rest:
        words.add("a value")
        rest -= _VALUES
    if len(rest & _OPERATORS) > 3:
        words.add("an operator")
        rest -= _OPERATORS | {"DOT", "QMARK", "LPAR", "COMMA", "AND", "OR"}
    words |= {TERMINAL_WORDS.get(name, f"`{name.lower()}`") for name in rest}
    listed = sorted(words)[:8]
    return " or ".join(filter(None, [", ".join(listed[:-1]), listed[-1]])) if listed else ""
