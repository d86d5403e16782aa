"""Text files as sources: every rule file, scene, task and study is read here."""

from __future__ import annotations

import errno
from pathlib import Path

from powderdsl.diagnostics import Reporter, Source, Span
from powderdsl.syntax.yaml_tree import MAX_CHARACTERS
from powderdsl.system.reading import inside, read_bytes

MAX_BYTES = 4 * MAX_CHARACTERS


def read_source(path: Path, reporter: Reporter, *, limit: int = MAX_BYTES) -> Source | None:
    """The text of a UTF-8 file, or None after reporting PD101 or PD102. Its name is relative where it lies below here.

    Args:
        limit: bytes that it may have.
    """
    try:
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
    except (ValueError, OSError, RuntimeError):  # it lies elsewhere; it is a loop of links
        name = str(path)
    return Source(name, text)


def path_beside(name: str, span: Span, reporter: Reporter) -> Path | None:
    """The path of a file that a text names at `span`, beside the text's file or below; None after reporting PD112."""
    try:
        return inside(Path(span.source.name).parent, name)
    except ValueError as error:
        helps = ["move the file into this folder or below it, and write its path from here"]
        reporter.error(
            "PD112", f"the path `{name}` leaves the folder of the file", span, str(error), helps=helps
        )
        return None
