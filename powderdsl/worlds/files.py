"""Reading world files within bounds, and writing files whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from powderdsl.diagnostics import CompileError, Diagnostic, Label, Reporter, Source
from powderdsl.scratch import scratch_file
from powderdsl.syntax.yaml_tree import MAX_CHARACTERS


def failure(
    code: str, message: str, *, notes: tuple[str, ...] = (), helps: tuple[str, ...] = ()
) -> CompileError:
    """A single error without a place in a text: about a file, a picture, a size."""
    return CompileError([Diagnostic(code, message, Label(None), notes=notes, helps=helps)])


def read_source(path: Path, reporter: Reporter, *, limit: int = MAX_CHARACTERS) -> Source | None:
    """The text of a UTF-8 file of at most `limit` bytes, or None after reporting PD101 or PD102."""
    try:
        with path.open("rb") as file:
            data = file.read(limit + 1)  # never more, whatever a file or a device says about its size
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        reason = getattr(error, "strerror", None) or str(error)
        reporter.error("PD101", f"cannot read {path}", None, notes=[reason])
        return None
    if len(data) > limit:
        reporter.error("PD102", f"{path} is too large", None, notes=[f"it may have {limit:,} bytes"])
        return None
    try:
        return Source(str(path), data.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        reporter.error(
            "PD101", f"{path} is not UTF-8 text", None, notes=[f"byte {error.start} cannot be decoded"]
        )
        return None


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside `path`, with its suffix, that takes its place when the block ends well.

    When the block fails or is interrupted, nothing is left and an older file stays as it was. When the process is
    killed, the next one that writes to the folder removes what is left. Raises CompileError (PD613) if the place cannot
    be written.
    """
    with ExitStack() as stack:
        try:
            temporary = stack.enter_context(scratch_file(path))
        except (OSError, ValueError) as error:
            raise _not_writable(path, error) from None
        yield temporary
        # Scratch files are private to their owner; an ordinary new file follows the umask.
        temporary.chmod(0o666 & ~_umask())
        try:
            os.replace(temporary, path)
        except OSError as error:
            raise _not_writable(path, error) from None


def _not_writable(path: Path, error: Exception) -> CompileError:
    reason = getattr(error, "strerror", None) or str(error)
    return failure("PD613", f"cannot write {path}", notes=(reason,))


def _umask() -> int:
    # There is no way to read it but to set it.
    mask = os.umask(0)
    os.umask(mask)
    return mask
