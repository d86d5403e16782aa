"""Arrays in .npz files, as NumPy writes and reads them.

Files may come from strangers: the contents that an archive claims are checked before any of it is unpacked.
"""

from __future__ import annotations

import os
import re
import struct
import zipfile
from ast import literal_eval
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any, BinaryIO

from powderdsl.arrays import NDArray, np
from powderdsl.system.reading import open_regular

MAX_ENTRIES = 256
"""Maximum number of arrays in an archive."""
MAX_DIRECTORY = 1 << 20
"""Maximum bytes of its list of contents."""
MAX_HEADER = 10_000
"""Maximum bytes of an array's header."""
_MAGIC, _ALIGNMENT, _SHAPE_ROOM = b"\x93NUMPY\1\0", 64, 21
"""The first bytes of arrays of version 1.0; the alignment of their values; characters reserved for the first side."""
_TYPES = {f"<{name[0]}{size}": f"{name}{8 * size}" for name in ("int", "uint", "float") for size in (2, 4, 8)}
_TYPES |= {"|b1": "bool", "|i1": "int8", "|u1": "uint8"}
_END, _LOCATOR, _END64 = struct.Struct("<4s4H2LH"), 20, struct.Struct("<4sQ2H2L4Q")
"""The end of a zip file; before it, where it is large, bytes of a pointer and another end."""


class BadArchive(Exception):
    """An archive that is damaged or not an .npz."""


@dataclass(frozen=True)
class Header:
    """The header of an array, and the offset at which its bytes begin in the unpacked member.

    `dtype` is NumPy's name, such as ``uint8``, or ``str``; `itemsize` the bytes of a number or text.
    """

    shape: tuple[int, ...]
    dtype: str
    itemsize: int
    start: int
    entry: zipfile.ZipInfo

    @property
    def size(self) -> int:
        """The bytes of the values."""
        return prod(self.shape) * self.itemsize


@dataclass(frozen=True)
class Archive:
    """An open .npz: its headers by name, in the order of the file."""

    headers: Mapping[str, Header]
    _zip: zipfile.ZipFile

    def read(self, name: str) -> NDArray[Any]:
        """Read an array of numbers, of the size that its header claims; it is read-only. Raises BadArchive."""
        header = self.headers[name]
        if header.dtype == "str":
            raise BadArchive(f"`{name}` is not an array of numbers")
        return np.frombuffer(self._bytes(name), header.dtype).reshape(header.shape)

    def text(self, name: str) -> str:
        """Read a text. Raises BadArchive."""
        header = self.headers[name]
        if header.dtype != "str" or header.shape != ():
            raise BadArchive(f"`{name}` is not a text")
        with _as_bad_archive():
            return str(self._bytes(name), "utf-32-le").rstrip("\0")

    def _bytes(self, name: str) -> memoryview:
        header = self.headers[name]
        with _as_bad_archive():
            data = self._zip.read(header.entry)
        if len(data) != header.start + header.size:
            raise BadArchive(f"`{name}` does not have the bytes that it says")
        return memoryview(data)[header.start :]


@dataclass(frozen=True)
class Parts:
    """An array in parts, whose rows follow one another. `dtype` is NumPy's text, such as ``|u1``."""

    dtype: str
    shape: tuple[int, ...]
    parts: Iterable[NDArray[Any]]


def write_archive(file: BinaryIO, arrays: Mapping[str, NDArray[Any] | Parts | str], level: int = 6) -> None:
    """Write an .npz: with the default level of deflate, the bytes that `numpy.savez_compressed` writes; 0 stores them."""
    form = zipfile.ZIP_DEFLATED if level else zipfile.ZIP_STORED
    with zipfile.ZipFile(file, "w", form, compresslevel=level) as archive:
        for name, value in arrays.items():
            if isinstance(value, str):
                value = Parts(f"<U{len(value)}", (), [np.frombuffer(value.encode("utf-32-le"), np.uint8)])
            elif not isinstance(value, Parts):
                value = Parts(value.dtype.str, tuple(value.shape), [value])
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                member.write(_header_bytes(value.dtype, value.shape))
                for part in value.parts:
                    member.write(part.tobytes())


def _header_bytes(descr: str, shape: tuple[int, ...]) -> bytes:
    """The header of an array in C order, with room for a longer first side."""
    text = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}"
    text += " " * (_SHAPE_ROOM - len(str(shape[0]))) if shape else ""
    text += " " * (_ALIGNMENT - (len(_MAGIC) + 2 + len(text) + 1) % _ALIGNMENT) + "\n"
    return _MAGIC + struct.pack("<H", len(text)) + text.encode("latin-1")


@contextmanager
def open_archive(path: Path) -> Iterator[Archive]:
    """The headers of an .npz. No pickles, no structured arrays.

    Raises OSError if the file cannot be opened, BadArchive if it is damaged, or is not an .npz.
    """
    with open_regular(path) as file:
        with _as_bad_archive():
            _check_directory(file)
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


def _check_directory(file: BinaryIO) -> None:
    """Raise BadArchive for a list of contents that is too long: `zipfile` reads all of it at once."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - (1 << 16) - _END.size - _LOCATOR - _END64.size))
    tail = file.read()
    at = tail.rfind(b"PK\5\6")
    if at < 0:
        raise BadArchive("it is not an .npz file")
    *_, entries, length, _, _ = _END.unpack_from(tail, at)
    at64 = at - _LOCATOR - _END64.size
    if at64 >= 0 and tail[at64:].startswith(b"PK\6\6"):
        *_, entries, length, _ = _END64.unpack_from(tail, at64)
    if entries > MAX_ENTRIES or length > MAX_DIRECTORY:
        raise BadArchive(f"it has more than {MAX_ENTRIES} entries")


def _header(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> tuple[str, Header]:
    name = entry.filename.removesuffix(".npy")
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise BadArchive(f"`{name}` is packed in another way than .npz files are")
    with archive.open(entry) as member:
        if member.read(len(_MAGIC)) != _MAGIC:
            raise BadArchive(f"`{name}` is not an array")
        count = int.from_bytes(member.read(2), "little")
        if count > MAX_HEADER:
            raise BadArchive(f"`{name}` has a header of {count:,} bytes")
        text, start = member.read(count).decode("latin-1"), member.tell()
    values, refusal = None, BadArchive(f"`{name}` is not an array of numbers")
    with suppress(ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
        values = literal_eval(text.strip())
    match values:
        case {"descr": str(descr), "fortran_order": bool(fortran), "shape": tuple(shape)}:
            dtype = "str" if re.fullmatch("<U[0-9]{1,9}", descr) else _TYPES.get(descr)
        case _:
            raise refusal
    if dtype is None or any(type(side) is not int or side < 0 for side in shape):
        raise refusal
    if fortran:
        raise BadArchive(f"`{name}` is not in C order: save `numpy.ascontiguousarray` of it")
    itemsize = int(descr[2:]) * (4 if dtype == "str" else 1)
    header = Header(tuple(shape), dtype, itemsize, start, entry)
    if entry.file_size != header.start + header.size:
        raise BadArchive(f"`{name}` has {entry.file_size - header.start:,} bytes, not {header.size:,}")
    return name, header
