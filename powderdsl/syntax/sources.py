"""Reading text files: every rule file, scene, task and study."""

from __future__ import annotations

import errno
from pathlib import Path

from powderdsl.diagnostics import Reporter, Source, Span, suggest
from powderdsl.syntax.yaml_tree import MAX_CHARACTERS
from powderdsl.system.reading import inside, read_bytes
from powderdsl.system.writing import failure

MAX_BYTES = 4 * MAX_CHARACTERS


OPEN: dict[Path, str] = {}
"""Unsaved texts by resolved path, which are read instead of their files."""


def read_source(path: Path, reporter: Reporter, *, limit: int = MAX_BYTES) -> Source | None:
    """The text of a UTF-8 file, or None after reporting PD101 or PD102. Its name is relative if it is below the current
    folder.

    `limit`: bytes that it may have.
    """
    try:
        text = OPEN.get(path.resolve()) if OPEN else None
        if text is None:
            text = read_bytes(path, limit).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        reporter.error(
            "PD101", f"`{path}` is not UTF-8 text", None, notes=[f"byte {error.start} cannot be decoded"]
        )
        return None
    except OSError as error:
        if error.errno == errno.EFBIG:
            helps = ["check that this is the file you meant"]
            reporter.error("PD102", f"`{path}` is larger than {limit:,} bytes", None, helps=helps)
        else:
            reporter.error("PD101", f"cannot read `{path}`", None, notes=[error.strerror or str(error)])
        return None
    try:
        name = str(path.resolve().relative_to(Path.cwd()))
    except (ValueError, OSError, RuntimeError):  # it is elsewhere, or a loop of links
        name = str(path)
    return Source(name, text)


def shipped(folder: str) -> Path:
    """A shipped folder, `rules`, `tasks` or one below, in the installed package or the repository."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "data" / folder
    return installed if installed.is_dir() else package.parent / folder


def shipped_names(folder: str) -> list[str]:
    """Names of the YAML files in a shipped folder."""
    return sorted(path.stem for path in shipped(folder).glob("*.yaml"))


def find_source(text: str, folder: str, noun: str, reporter: Reporter) -> Source:
    """A file by name in a shipped folder, or by path. `noun` is its kind, for messages.

    Raises CompileError: PD801 for an unknown name, PD101 or PD102 for what cannot be read.
    """
    known = shipped_names(folder)
    if text not in known and not text.lower().endswith((".yaml", ".yml")):
        helps = suggest(text, known) or ("shipped: " + ", ".join(known),)
        raise failure("PD801", f"no {noun} `{text[:80]}`", helps=helps)
    source = read_source(shipped(folder) / f"{text}.yaml" if text in known else Path(text), reporter)
    reporter.raise_if_errors()
    assert source is not None
    return source


def path_beside(name: str, span: Span, reporter: Reporter) -> Path | None:
    """The path of a file named at `span`, in the folder of the text's file or below; None after reporting PD112."""
    try:
        return inside(Path(span.source.name).parent, name)
    except ValueError as error:
        helps = ["move the file into this folder or below it, and write its path from here"]
        reporter.error(
            "PD112", f"the path `{name}` leaves the folder of the file", span, str(error), helps=helps
        )
        return None
