"""The table of diagnostic codes, and the page of each: its meaning, an example, the fix.

A code is permanent: never reused, its page stays when it is retired.
"""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches
from enum import Enum
from pathlib import Path


class Severity(Enum):
    """An error stops; a warning is probably a mistake; a note is worth knowing."""

    ERROR = "error"
    WARNING = "warning"
    NOTE = "note"


@dataclass(frozen=True)
class Code:
    """A row: the code, its slug (names the fault, not the fix), how severe it is."""

    code: str
    slug: str
    severity: Severity


_ERROR, _WARNING, _NOTE = Severity.ERROR, Severity.WARNING, Severity.NOTE

_ROWS = (
    # PD1xx: files, YAML, shape
    ("PD101", "file-not-readable", _ERROR),
    ("PD102", "file-too-large", _ERROR),
    ("PD103", "invalid-yaml", _ERROR),
    ("PD104", "duplicate-key", _ERROR),
    ("PD105", "forbidden-yaml", _ERROR),
    ("PD106", "document-too-deep", _ERROR),
    ("PD107", "wrong-shape", _ERROR),
    ("PD108", "unknown-key", _ERROR),
    ("PD109", "missing-key", _ERROR),
    ("PD110", "invalid-literal", _ERROR),
    ("PD111", "invalid-name", _ERROR),
    ("PD112", "path-leaves-folder", _ERROR),
    ("PD113", "empty-section", _WARNING),
    # PD2xx: the syntax of one line
    ("PD201", "syntax-error", _ERROR),
    ("PD202", "expression-too-large", _ERROR),
    ("PD203", "quoted-expression", _ERROR),
    ("PD204", "mixed-list", _ERROR),
    # PD3xx: names
    ("PD301", "unknown-name", _ERROR),
    ("PD302", "redefinition", _ERROR),
    ("PD303", "duplicate-id", _ERROR),
    ("PD304", "unknown-pack", _ERROR),
    ("PD305", "missing-pack", _ERROR),
    ("PD306", "conflicting-packs", _ERROR),
    ("PD307", "pass-cycle", _ERROR),
    ("PD308", "shadowed-name", _ERROR),
    ("PD309", "unknown-parameter", _ERROR),
    ("PD310", "unknown-ruleset-entry", _ERROR),
    ("PD311", "reserved-word", _ERROR),
    ("PD312", "name-qualified", _NOTE),
    ("PD313", "id-taken", _NOTE),
    ("PD314", "ruleset-cycle", _ERROR),
    ("PD315", "optional-name-misspelled", _WARNING),
    ("PD316", "value-contested", _WARNING),
    ("PD317", "value-replaced", _NOTE),
    ("PD318", "override-changes-id", _WARNING),
    # PD4xx: kinds and ranges
    ("PD401", "wrong-kind", _ERROR),
    ("PD402", "value-out-of-range", _ERROR),
    ("PD403", "chance-out-of-range", _ERROR),
    ("PD404", "chance-not-representable", _WARNING),
    ("PD405", "not-constant", _ERROR),
    ("PD406", "wrong-arguments", _ERROR),
    ("PD407", "not-assignable", _ERROR),
    ("PD408", "range-overflow", _WARNING),
    ("PD409", "offset-too-far", _ERROR),
    # PD5xx: the logic of rules
    ("PD501", "movement-conflict", _ERROR),
    ("PD502", "write-conflict", _ERROR),
    ("PD503", "rule-never-fires", _WARNING),
    ("PD504", "element-never-appears", _NOTE),
    ("PD505", "empty-set", _NOTE),
    ("PD506", "rule-asleep", _NOTE),
    ("PD507", "unused-definition", _WARNING),
    ("PD508", "expansion-too-large", _ERROR),
    ("PD509", "rule-does-nothing", _WARNING),
    ("PD510", "invariant-says-nothing", _WARNING),
    ("PD511", "invariant-cannot-hold", _ERROR),
    ("PD512", "invariant-broken", _ERROR),
    ("PD513", "condition-decides-nothing", _WARNING),
    ("PD514", "rule-overruled", _WARNING),
    ("PD515", "scope-outgrown", _NOTE),
    ("PD516", "write-lost", _WARNING),
    ("PD517", "conflict-with-added-pack", _WARNING),
    ("PD518", "effect-undecided", _NOTE),
    # PD6xx: worlds, scenes, files
    ("PD601", "unknown-world", _ERROR),
    ("PD602", "invalid-world-file", _ERROR),
    ("PD603", "palette-mismatch", _ERROR),
    ("PD604", "unknown-world-element", _ERROR),
    ("PD605", "invalid-statement", _ERROR),
    ("PD606", "invalid-number", _ERROR),
    ("PD607", "invalid-world-size", _ERROR),
    ("PD608", "empty-shape", _ERROR),
    ("PD609", "unknown-color", _ERROR),
    ("PD610", "unknown-glyph", _ERROR),
    ("PD611", "ragged-rows", _ERROR),
    ("PD612", "missing-package", _ERROR),
    ("PD613", "file-not-writable", _ERROR),
    ("PD620", "no-such-run", _ERROR),
    ("PD621", "another-run", _ERROR),
    ("PD622", "run-in-use", _ERROR),
    ("PD623", "run-does-not-fit", _ERROR),
    ("PD624", "training-diverged", _ERROR),
    ("PD625", "invalid-network", _ERROR),
    ("PD626", "no-cluster", _ERROR),
    ("PD627", "results-differ", _ERROR),
    ("PD630", "invalid-dataset", _ERROR),
    ("PD631", "dataset-mismatch", _ERROR),
    ("PD640", "invalid-setting", _ERROR),
    # PD7xx: limits of a backend
    ("PD701", "backend-not-available", _ERROR),
    ("PD702", "too-large-for-webassembly", _ERROR),
    # PD8xx: tasks
    ("PD801", "unknown-task", _ERROR),
    ("PD802", "unknown-task-name", _ERROR),
    ("PD803", "invalid-knob", _ERROR),
    ("PD804", "invalid-agent", _ERROR),
    ("PD805", "constant-reward", _WARNING),
    ("PD806", "invalid-study", _ERROR),
    # PD9xx: our own mistakes
    ("PD901", "internal-error", _ERROR),
)

CODES: dict[str, Code] = {row[0]: Code(*row) for row in _ROWS}

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
    """The Markdown page of a code."""
    return (_PAGES / f"{row.code}.md").read_text(encoding="utf-8")
