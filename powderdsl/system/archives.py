"""Arrays of .npz files from strangers: the contents that an archive claims are checked before any of it is unpacked."""

from __future__ import annotations

import os
import struct
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from powderdsl.system.reading import open_regular

MAX_ENTRIES = 256
"""Maximum number of arrays in an archive."""
MAX_DIRECTORY = 1 << 20
"""Maximum bytes of its list of contents."""
MAX_HEADER = 10_000
"""Maximum bytes of an array's header."""
_END, _END64 = struct.Struct("<4s4H2LH"), struct.Struct("<4sQ2H2L4Q")
_LOCATOR = 20


class BadArchive(Exception):
    """What is wrong with an archive."""


@dataclass(frozen=True)
class Header:
    """What an array claims to be, and where its bytes begin in the unpacked member."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    fortran: bool
    start: int
    entry: zipfile.ZipInfo

    @property
    def size(self) -> int:
        """Bytes."""
        return prod(self.shape) * self.dtype.itemsize


@dataclass(frozen=True)
class Archive:
    """An open .npz: its headers by name, in the order of the file."""

    headers: Mapping[str, Header]
    _zip: zipfile.ZipFile

    @property
    def size(self) -> int:
        """Bytes of all arrays."""
        return sum(header.size for header in self.headers.values())

    def read(self, name: str) -> NDArray[Any]:
        """Read an array of the size that its header claims; it is read-only. Raises BadArchive."""
        header = self.headers[name]
        with _as_bad_archive(), self._zip.open(header.entry) as member:
            data = member.read()
        if len(data) != header.start + header.size:
            raise BadArchive(f"`{name}` does not have the bytes that it says")
        flat = np.frombuffer(data, header.dtype, offset=header.start)
        return flat.reshape(header.shape, order="F" if header.fortran else "C")


@contextmanager
def open_archive(path: Path) -> Iterator[Archive]:
    """The headers of an .npz. No pickles, no structured arrays.

    Raises:
        OSError: the file cannot be opened. BadArchive: it is damaged, or is not an .npz.
    """
    with open_regular(path) as file:
        with _as_bad_archive():
            check_directory(file, MAX_ENTRIES, MAX_DIRECTORY)
            archive = zipfile.ZipFile(file)
        with archive:
            with _as_bad_archive():
                headers = dict(_header(archive, entry) for entry in archive.infolist())
            if len(headers) != len(archive.infolist()):
                raise BadArchive("two of its arrays have one name")
            yield Archive(headers, archive)


@contextmanager
def _as_bad_archive() -> Iterator[None]:
    try:
        yield
    except BadArchive:
        raise
    except Exception as error:  # a damaged archive raises whatever its codec likes
        words = " ".join(str(error).split())[:200]
        raise BadArchive(words or type(error).__name__) from None


def check_directory(file: BinaryIO, most: int, size_of_list: int) -> None:
    """Raise BadArchive for a list of contents that is too long: `zipfile` reads all of it at once.

    Args:
        most: entries. size_of_list: bytes of the list.
    """
    size = file.seek(0, os.SEEK_END)
    tail_start = max(0, size - _END.size - (1 << 16) - _END64.size - _LOCATOR)
    file.seek(tail_start)
    tail = file.read()
    at = tail.rfind(b"PK\5\6")
    if at < 0 or len(tail) - at < _END.size:
        raise BadArchive("it is not an .npz file")
    _, _, _, _, entries, length, _, _ = _END.unpack_from(tail, at)
    at64 = at - _LOCATOR - _END64.size
    if at >= _LOCATOR and tail[at - _LOCATOR :].startswith(b"PK\6\7"):
        if at64 < 0 or not tail[at64:].startswith(b"PK\6\6"):
            raise BadArchive("its list of contents is damaged")
        *_, entries, length, _ = _END64.unpack_from(tail, at64)
    if entries > most or length > size_of_list:
        raise BadArchive(f"it has more than {most:,} entries")
    file.seek(0)


def _header(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> tuple[str, Header]:
    name = entry.filename.removesuffix(".npy")
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise BadArchive(f"`{name}` is packed in another way than .npz files are")
    with archive.open(entry) as member:
        version = np.lib.format.read_magic(member)
        if version not in ((1, 0), (2, 0)):
            raise BadArchive(f"`{name}` has the npy version {version}")
        read = (
            np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        )
        shape, fortran, dtype = read(member, max_header_size=MAX_HEADER)
        header = Header(shape, dtype, fortran, member.tell(), entry)
    if dtype.kind not in "biufU" or dtype.subdtype is not None or any(side < 0 for side in shape):
        raise BadArchive(f"`{name}` is not an array of numbers")
    if entry.file_size != header.start + header.size:
        raise BadArchive(f"`{name}` has {entry.file_size - header.start:,} bytes, not {header.size:,}")
    return name, header
