"""Pages that explain a diagnostic code: what it means, an example, the fix. One Markdown file a code."""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path

from powderdsl.diagnostics.codes import CODES, Code

_PAGES = Path(__file__).resolve().parent / "pages"


def find_code(word: str) -> Code | None:
    """The row of a code (``PD301``, ``pd301``, ``301``) or of a slug (``unknown-name``)."""
    text = word.strip().strip("[]`").lower().replace("_", "-").replace(" ", "-")
    by_name = {row.code.lower(): row for row in CODES.values()} | {row.slug: row for row in CODES.values()}
    return by_name.get(text) or by_name.get(f"pd{text}")


def similar(word: str) -> tuple[str, ...]:
    """Codes and slugs that look like an unknown one; all codes of its hundred if it looks like a code."""
    text = word.strip().lower()
    known = {name.lower(): name for row in CODES.values() for name in (row.code, row.slug)}
    if text.startswith("pd") and len(text) >= 3:
        hundred = tuple(code for code in CODES if code.lower().startswith(text[:3]))
        if hundred:
            return hundred
    return tuple(known[name] for name in get_close_matches(text, known, n=3, cutoff=0.5))


def page(row: Code) -> str:
    """The Markdown page of a code. A code without a page still says what it is called."""
    path = _PAGES / f"{row.code}.md"
    if path.is_file():
        return path.read_text(encoding="utf-8")
    return f"# {row.code}: {row.slug.replace('-', ' ')}\n\nThis {row.severity.value} has no page yet.\n"
