"""The table of diagnostic codes, and their pages: the meaning, an example, and a fix.

Codes are permanent: they are never reused, and a retired code keeps its page.
"""

from __future__ import annotations

from difflib import get_close_matches
from enum import Enum
from pathlib import Path
from typing import NamedTuple


class Severity(Enum):
    """The severity of a diagnostic: an error stops, a warning is probably a mistake, a note is information."""

    ERROR = "error"
    WARNING = "warning"
    NOTE = "note"


class Code(NamedTuple):
    """A code, its slug (which names the fault, not the fix), and its severity."""

    code: str
    slug: str
    severity: Severity = Severity.ERROR


_WARNING, _NOTE = Severity.WARNING, Severity.NOTE

_ROWS = (
    # PD1xx: files, YAML, shape
    ("PD101", "file-not-readable"),
    ("PD102", "file-too-large"),
    ("PD103", "invalid-yaml"),
    ("PD104", "duplicate-key"),
    ("PD105", "forbidden-yaml"),
    ("PD106", "document-too-deep"),
    ("PD107", "wrong-shape"),
    ("PD108", "unknown-key"),
    ("PD109", "missing-key"),
    ("PD110", "invalid-literal"),
    ("PD111", "invalid-name"),
    ("PD112", "path-leaves-folder"),
    ("PD113", "empty-section", _WARNING),
    # PD2xx: the syntax of one line
    ("PD201", "syntax-error"),
    ("PD202", "expression-too-large"),
    ("PD203", "quoted-expression"),
    ("PD204", "mixed-list"),
    # PD3xx: names
    ("PD301", "unknown-name"),
    ("PD302", "redefinition"),
    ("PD303", "duplicate-id"),
    ("PD304", "unknown-pack"),
    ("PD305", "missing-pack"),
    ("PD306", "conflicting-packs"),
    ("PD307", "pass-cycle"),
    ("PD308", "shadowed-name"),
    ("PD309", "unknown-parameter"),
    ("PD310", "unknown-ruleset-entry"),
    ("PD311", "reserved-word"),
    ("PD312", "name-qualified", _NOTE),
    ("PD313", "id-taken", _NOTE),
    ("PD314", "ruleset-cycle"),
    ("PD315", "optional-name-misspelled", _WARNING),
    ("PD316", "value-contested", _WARNING),
    ("PD317", "value-replaced", _NOTE),
    ("PD318", "override-changes-id", _WARNING),
    ("PD319", "need-not-declared", _WARNING),
    # PD4xx: kinds and ranges
    ("PD401", "wrong-kind"),
    ("PD402", "value-out-of-range"),
    ("PD403", "chance-out-of-range"),
    ("PD404", "chance-not-representable", _WARNING),
    ("PD405", "not-constant"),
    ("PD406", "wrong-arguments"),
    ("PD407", "not-assignable"),
    ("PD408", "range-overflow", _WARNING),
    ("PD409", "offset-too-far"),
    ("PD410", "alternatives-not-joined"),
    # PD5xx: the logic of rules
    ("PD501", "movement-conflict"),
    ("PD502", "write-conflict"),
    ("PD503", "rule-never-fires", _WARNING),
    ("PD505", "empty-set", _NOTE),
    ("PD506", "inactive-rule", _NOTE),
    ("PD507", "unused-definition", _WARNING),
    ("PD508", "expansion-too-large"),
    ("PD509", "rule-does-nothing", _WARNING),
    ("PD510", "invariant-says-nothing", _WARNING),
    ("PD511", "invariant-cannot-hold"),
    ("PD512", "invariant-broken"),
    ("PD513", "condition-decides-nothing", _WARNING),
    ("PD514", "rule-overruled", _WARNING),
    ("PD515", "scope-outgrown", _NOTE),
    ("PD516", "write-lost", _WARNING),
    ("PD517", "conflict-with-added-pack", _WARNING),
    ("PD518", "effect-undecided", _NOTE),
    # PD6xx: worlds, scenes, files
    ("PD601", "unknown-world"),
    ("PD602", "invalid-world-file"),
    ("PD603", "palette-mismatch"),
    ("PD604", "unknown-world-element"),
    ("PD605", "invalid-statement"),
    ("PD606", "invalid-number"),
    ("PD607", "invalid-world-size"),
    ("PD608", "empty-shape"),
    ("PD609", "unknown-color"),
    ("PD610", "unknown-glyph"),
    ("PD611", "ragged-rows"),
    ("PD612", "missing-package"),
    ("PD613", "file-not-writable"),
    ("PD620", "no-such-run"),
    ("PD621", "another-run"),
    ("PD622", "run-in-use"),
    ("PD623", "run-does-not-fit"),
    ("PD624", "training-diverged"),
    ("PD625", "invalid-network"),
    ("PD626", "no-cluster"),
    ("PD627", "results-differ"),
    ("PD630", "invalid-dataset"),
    ("PD631", "dataset-mismatch"),
    ("PD640", "invalid-setting"),
    # PD7xx: limits of a backend
    ("PD701", "backend-not-available"),
    ("PD702", "too-large-for-webassembly"),
    # PD8xx: tasks
    ("PD801", "unknown-task"),
    ("PD802", "unknown-task-name"),
    ("PD803", "invalid-knob"),
    ("PD804", "invalid-agent"),
    ("PD805", "constant-reward", _WARNING),
    ("PD806", "invalid-study"),
    ("PD807", "laws-not-held-out", _WARNING),
    # PD9xx: bugs of powderdsl
    ("PD901", "internal-error"),
)

CODES: dict[str, Code] = {code: Code(code, *rest) for code, *rest in _ROWS}

_PAGES = Path(__file__).resolve().parent / "pages"


def find_code(word: str) -> Code | None:
    """The row of a code (``PD301``, ``pd301``, ``301``) or of a slug (``unknown-name``)."""
    text = word.strip().strip("[]`").lower().replace("_", "-").replace(" ", "-")
    by_name = {row.code.lower(): row for row in CODES.values()} | {row.slug: row for row in CODES.values()}
    return by_name.get(text) or by_name.get(f"pd{text}")


def similar(word: str) -> tuple[str, ...]:
    """Codes and slugs similar to an unknown word; all codes with its first digit if it looks like a code."""
    text = word.strip().lower()
    known = {name.lower(): name for row in CODES.values() for name in (row.code, row.slug)}
    if text.startswith("pd") and len(text) >= 3:
        hundred = tuple(code for code in CODES if code.lower().startswith(text[:3]))
        if hundred:
            return hundred
    return tuple(known[name] for name in get_close_matches(text, known, n=3, cutoff=0.5))


def page(row: Code) -> str:
    return (_PAGES / f"{row.code}.md").read_text(encoding="utf-8")
