"""Hints for syntax errors: words for what could follow, and fixes for common slips."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping, Set
from difflib import get_close_matches

TERMINAL_WORDS = {
    "NAME": "a name",
    "QUALIFIED": "a name",
    "INTEGER": "an integer",
    "DECIMAL": "a number",
    "PERCENT": "a percentage",
    "UPDATE": "`:=`",
    "COMPARE": "a comparison",
    "$END": "the end of the line",
}
"""The name in messages of each terminal that stands for several texts."""

_VALUE_STARTS = {"NAME", "INTEGER", "LPAR"}
_LITERALS = {"DECIMAL", "PERCENT", "YES", "NO", "TRUE", "FALSE"}
_VALUES = _VALUE_STARTS | _LITERALS | {"CHANCE", "ANY", "ALL", "MINUS", "NOT"}
_OPERATORS = {"PLUS", "MINUS", "STAR", "SLASH", "DIV", "MOD", "COMPARE", "IS", "IN", "NOT", "_DOTS"}

_CHARACTERS: tuple[tuple[str, str], ...] = (
    (r"\b(if|where|chance)\b.*‸=>", "write `>=`"),
    (r"‸=>", "write `->`"),
    (r"‸=<", "write `<=`"),
    (r"‸=!", "write `!=`"),
    (r"\b(if|where|chance)\b.*‸=", "compare with `==`, ask for an element with `is`"),
    (r"^(.*\bthen)?\s*[\w.?]+\s*‸=", "assign with `:=`"),
    (r"‸=", "compare with `==`, ask for an element with `is`, assign with `:=`"),
    (r"‸&", "write `and`"),
    (r"‸\|", "write `or`"),
    (r"‸!", "write `not`, or `!=` between two values"),
    (r"‸[{}]", "write rules without braces"),
    (r"‸[\[\]]", "a set is written `(a, b)`"),
    (r"‸→", "write `->`"),
    (r"‸≥", "write `>=`"),
    (r"‸≤", "write `<=`"),
    (r"‸≠", "write `!=`"),
    (r"‸×", "write `*`"),
    (r"‸[\"'“]", "names are written without quotes"),
    (r"‸:", "assign with `:=`"),
    (r"‸;", "a line is one rule: put the next one on its own line"),
    (r"‸%", "a percentage is a number and `%`, without a space; the remainder of a division is `mod`"),
    (r"‸\^", "there is no power operator: write `x * x`"),
    (r"‸#", "a comment needs a space before its `#`"),
)
"""Characters that no rule contains: the line, with an `‸` before the character, and the fix. The first match counts."""

_WORDS = {
    **dict.fromkeys(("when", "where", "while", "provided"), "if"),
    "unless": "if not",
    **dict.fromkeys(("becomes", "become", "into", "to", "turns"), "->"),
    "equals": "==",
    **dict.fromkeys(("chance", "probability"), "with chance"),
    "but": "and not",
    "swap": "swaps",
    "move": "moves",
    "leaves": "leaving",
    "than": ", then",
    "else": "a if b else c",
}
"""Words from other languages, and the language's own."""

_LETTERS = (
    "\u0430\u0435\u043e\u0440\u0441\u0443\u0445\u0456\u0458\u0455\u0410\u0412\u0415\u041a\u041c\u041d\u041e\u0420\u0421\u0422\u0425"
    "\u03bf\u03b1\u03bd\u0391\u0392\u0395\u0397\u0399\u039a\u039c\u039d\u039f\u03a1\u03a4\u03a7\u0131"
)
"""Letters that look like ASCII ones: Cyrillic, Greek, and an i without its dot."""

_LOOK_ALIKES = {
    **dict.fromkeys("\u00ad\u200b\u200c\u200d\u2060\ufeff\u200e\u200f", ""),
    **dict.fromkeys("\u00a0\u2002\u2003\u2009\u202f\u3000", " "),
    **dict.fromkeys("\u2013\u2014\u2010\u2011\u2212", "-"),
    "\u2026": "..",
    "\u037e": ";",
    **dict.fromkeys("\u2018\u2019", "'"),
    **dict.fromkeys("\u201d\u201e", '"'),
    **dict(zip(_LETTERS, "aeopcyxijsABEKMHOPCTXoavABEHIKMNOPTXi", strict=True)),
}
"""Characters that look like others or are invisible, and the intended character."""

CUT = "inside `{…}` and `[…]`, a comma ends a value: quote the value, or put it on its own line"


def character_help(text: str, position: int, begin: int) -> str:
    """The fix for a character that no rule contains, or an empty string. The line starts at `begin`."""
    fix = _LOOK_ALIKES.get(text[position])
    if fix is None and not text[position].isascii():
        plain = unicodedata.normalize("NFKC", text[position])
        fix = plain if plain.isascii() and plain.isprintable() else None
    if fix is not None:
        wanted = "a plain space" if fix == " " else f"`{fix}`" if fix else ""
        return f"it only looks like {wanted}: type {wanted}" if wanted else "it is invisible: remove it"
    line = f"{text[begin:position]}‸{text[position : position + 2]}"
    return next((fix for pattern, fix in _CHARACTERS if re.search(pattern, line, re.DOTALL)), "")


def was_cut(text: str, begin: int, end: int) -> bool:
    """True if a comma of YAML's `{…}` or `[…]` is right before or after the line."""
    before, after = text[max(begin - 64, 0) : begin], text[end : end + 64]
    return before.rstrip(" ").endswith(",") or after.lstrip(" ").startswith(",")


_NAME = r"([^\W\d]\w*)"
_NOT_ELEMENTS = "|".join(_WORDS) + "|is|in|and|or|if|mod|div|not|leaving|then|with|where"
_WITHOUT_WHERE = "write the condition of an assignment after `where`: `field := value where condition`"
_NEXT_LINE = (
    "each rule of a list starts with `- `; a rule that continues on the next line does so with `if`, `and`, …"
)
_WITHOUT_LEAVING = "a move must name what it leaves behind: `SET moves below leaving ELEMENT if …`"

_PHRASES: tuple[tuple[str, str, str], ...] = (
    (r"\n\s*-\s.*‸", "", "an item of a list starts with `- `: this one, or the one before it, lacks it"),
    (rf"\n\s*‸{_NAME}$", "", _NEXT_LINE),
    (rf"\b(count|sum)\s*‸{_NAME}$", "", r"write `\1(\2)`"),
    (rf"\b(above|below|left|right|here)\s*‸(?!({_NOT_ELEMENTS})$){_NAME}$", "", r"write `\1 is \3`"),
    (r"\bswaps\s*‸with$", "", "write `swaps PLACE`, without `with`"),
    (rf"^\s*set\s*‸{_NAME}$", "", r"write `\1 := VALUE where …`"),
    (r"(^|[\s(<>=+*/-])‸\.$", "", "write a digit before the decimal point: `0.5`"),
    (r"^\s*(\w+)([+-])\s*‸\2$", "", r"write `\1 \2= 1`"),
    (r"\*‸\*$", "", "there is no power operator: write `x * x`"),
    (r"\bmoves\s+\S+\s*‸$", "", _WITHOUT_LEAVING),
    (r"\.\.\s*‸$", "", "a range has two ends: `0..99`"),
    (r"‸(:=|\+=|-=)$", "", "only a field of this cell, or of a neighbor, can be assigned"),
    (r"\bthen\b.*‸", "ELSE", "a choice has two sides: `VALUE if CONDITION else VALUE`"),
    (r"(:=|\+=|-=).*‸$", "ELSE", _WITHOUT_WHERE),
    (r"\bchance\s+\S+\s*‸if$", "", "the chance comes last: `… if CONDITION with chance 5%`"),
    (
        r"\b(count|sum)\([^()]*[<>=][^()]*‸in$",
        "",
        r"put the condition in parentheses: `\1((CONDITION) in ring)`",
    ),
    (r"\b(count|sum)\([^()]*\)\s*(in\s.*‸|.*‸of$)", "", r"put the neighborhood inside: `\1(SET in ring)`"),
    (r"\b(any|all)\b[^()]*\(?[^()]*‸(\)|\w+)$", "", r"write `\1(side is SET for side in sides)`"),
    (r"\b(an?|the)\s*‸\w+$", "", r"leave out `\1`"),
    (r"^\s*(spawn|create|add|make|place)\s*‸(\w+)", "", r"write `empty -> \2 with chance 1%`"),
    (r"‸(after|for)$", "WITH", "a field counts steps: `age += 1 where SET`, and `… if age > 3`"),
    (r"‸if$", "WHERE", _WITHOUT_WHERE),
    (r"‸if$", "LEAVING", _WITHOUT_LEAVING),
    (r"^\s*‸if$", "", "write the effect of a rule first: `this -> that if …`"),
    (r"‸where$", "", "only assignments use `where`; write `if` in this rule"),
    (r" is\s*‸in$", "", "write `is` or `in`, not both"),
    (r"‸if$", "_ARROW", "write the effect before the `if`: `SET -> ELEMENT if …`"),
    (r"\b(box|ring|disc|diamond|cross|plus)\s*‸(\d+)$", "", r"write `\1(\2)`"),
    (r"/‸/$", "", "integer division, rounded down, is `div`: `a div b`"),
    (r"->.*‸->$", "", "a line is one rule: put the next one on its own line"),
    (r"‸(.*%)$", "CHANCE", r"write `with chance \1`, at the end of the rule"),
    (r"‸(.*%)$", "WITH", r"write `with chance \1`"),
    (r"chance\s*‸(.*%)$", "", r"write `with chance \1`"),
    (r",\s*‸(?!\))", "THEN", "one line is one rule; effects follow `then`: `…, then field := value`"),
)
"""Phrases from other languages, and slips: the line, with an `‸` before the word that cannot follow; a
terminal that could have followed; the fix. The first match counts."""


def token_help(token: str, accepted: Set[str], fixed: Mapping[str, str], before: str, cut: bool) -> str:
    """The fix for an unexpected word. `token` is empty at the end of the line.

    `accepted` are the terminals that could follow, `fixed` are the texts of terminals that have only one, `before` is the
    line up to the error.
    """
    if cut and not (token and before.strip()):
        return CUT
    for pattern, terminal, fix in _PHRASES:
        match = re.search(pattern, f"{before}‸{token}", re.DOTALL)
        if match and (not terminal or terminal in accepted):
            return match.expand(fix)
    missing = before.count("(") - before.count(")")
    if token == ")" and missing <= 0:
        return "no `(` is open: remove it"
    if not token and missing > 0:
        return "write the missing `)`"
    instead = _WORDS.get(token.lower(), "")
    if instead and token != instead:
        return f"write `{instead}`"
    keywords = {fixed[name] for name in accepted & fixed.keys() if name.isalpha() and fixed[name].isalpha()}
    close = get_close_matches(token.lower(), sorted(keywords - {token}), n=1, cutoff=0.7)
    return f"did you mean `{close[0]}`?" if close else ""


def expected_words(accepted: Set[str], fixed: Mapping[str, str]) -> str:
    """The terminals that could have followed, in words. `fixed` is as in `token_help`."""
    words = set()
    rest = set(accepted)
    if _VALUE_STARTS <= rest:
        words.add("a value")
        rest -= _VALUES
    if len(rest & _OPERATORS) > 3:
        words.add("an operator")
        rest -= _OPERATORS | {"DOT", "QMARK", "LPAR", "COMMA", "AND", "OR"}
    words |= {TERMINAL_WORDS.get(name) or f"`{fixed[name]}`" for name in rest}
    listed = sorted(words)[:8]
    return " or ".join(filter(None, [", ".join(listed[:-1]), listed[-1]])) if listed else ""
