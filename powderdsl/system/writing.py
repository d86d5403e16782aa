"""Atomic writing of files, the user's private cache, and errors about files."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from secrets import token_hex
from tempfile import TemporaryDirectory

from powderdsl.diagnostics import CompileError, Diagnostic, Label
from powderdsl.system.reading import check_regular

MARK = ".powderdsl-"
"""A part of the names of temporary files."""


def failure(
    code: str, message: str, *, notes: tuple[str, ...] = (), helps: tuple[str, ...] = ()
) -> CompileError:
    """A single error without a location in a text: about a file, a picture, a size."""
    return CompileError([Diagnostic(code, message, Label(None), notes=notes, helps=helps)])


@contextmanager
def replacing(path: Path, *, follow: bool = False) -> Iterator[Path]:
    """A temporary path in the folder of `path`, with its suffix, that replaces it when the block succeeds.

    If the block fails or is interrupted, the temporary file is removed and an older file is unchanged. Raises
    CompileError (PD613) if the file cannot be written, by the block itself too.

    `follow`: replace the target of a link, for paths named by the user. By default, the link itself is replaced, since
    it may be in an untrusted folder.
    """
    target = destination(path, follow=follow)
    temporary = target.parent / f".{target.stem[:40]}{MARK}{token_hex(8)}{target.suffix}"
    try:
        try:
            os.close(os.open(temporary, os.O_CREAT | os.O_EXCL, 0o600))
        except (OSError, ValueError) as error:
            raise not_writable(path, error) from None
        with writing(path):
            yield temporary
            # Temporary files are private to their owner; a new file follows the umask, which can only be set.
            mask = os.umask(0)
            os.umask(mask)
            temporary.chmod(0o666 & ~mask)
            os.replace(temporary, target)
    finally:
        with suppress(OSError, ValueError):
            temporary.unlink()


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Raise errors of the system inside the block as an error of writing `path`: CompileError (PD613)."""
    try:
        yield
    except OSError as error:
        raise not_writable(path, error) from None


@contextmanager
def scratch_folder(parent: Path) -> Iterator[Path]:
    """An empty folder in `parent` that only its owner can read, removed with its contents at the end.

    Raises OSError if it cannot be made there.
    """
    with TemporaryDirectory(prefix=MARK, dir=parent, ignore_cleanup_errors=True) as name:
        yield Path(name)


def write_text(path: Path, text: str) -> None:
    """Write a text as UTF-8, atomically, as `replacing` does. Raises CompileError (PD613)."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def destination(path: Path, *, follow: bool) -> Path:
    """The path that a write replaces: the path itself, or the target of a link.

    Raises CompileError (PD613) if something other than a file exists there, or links form a loop.
    """
    try:
        target = path.resolve() if follow and path.is_symlink() else path
        if target.exists() and (follow or not path.is_symlink()):
            check_regular(target)
    except (OSError, ValueError, RuntimeError) as error:
        raise not_writable(path, error) from None
    return target


def not_writable(path: Path, error: Exception) -> CompileError:
    """PD613, with the system's reason."""
    reason = getattr(error, "strerror", None) or str(error)
    return failure("PD613", f"cannot write {path}", notes=(reason,))


def cache_folder(name: str) -> Path:
    """A folder of the user's cache, created with mode 0700, since its contents are loaded and executed.

    Raises OSError if it cannot be created, belongs to another user, or others may write to it; or there is no home
    folder.
    """
    try:
        top = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "powderdsl"
    except RuntimeError as error:
        raise OSError(str(error)) from None
    for folder in (top, top / name):
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        check_private(folder)
    return top / name


def check_private(folder: Path) -> None:
    """Reject a folder to which another user may write. Raises PermissionError."""
    if not hasattr(os, "getuid"):
        return
    # A link is checked too: its owner decides where it leads.
    for status in (folder.lstat(), folder.stat()):
        if status.st_uid != os.getuid():
            raise PermissionError(f"{folder} belongs to another user")
    if folder.stat().st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise PermissionError(f"others may write to {folder}: empty it, then `chmod 700` it")
