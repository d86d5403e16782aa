"""Shards: whole episodes as flat arrays in one .npz, written whole or not at all, read where they lie on disk.

An episode of T actions has T rows of `action`, `reward`, `terminated`, `truncated`, `success`, and T + 1 of
`observation`; episodes follow one another. So row t of an episode's observations is what its action t was taken at,
and row t + 1 what came of it, also at its end. Arrays that are not compressed are mapped, not read. No torch.
"""

from __future__ import annotations

import hashlib
import os
import zipfile
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from powderdsl.datasets.manifest import Recipe, ShardRow, reporting_damage, shard_file
from powderdsl.system.archives import BadArchive, Parts, open_archive, write_archive
from powderdsl.system.reading import open_regular
from powderdsl.system.writing import replacing

Array = NDArray[Any]

DTYPES = {
    "observation": "|u1",
    "action": "<i2",
    "reward": "<f4",
    "terminated": "|b1",
    "truncated": "|b1",
    "success": "|b1",
    "length": "<i4",
    "world": "<i8",
}
LEVEL = 1
"""Compression level of deflate. Higher levels take three to five times as long for a quarter less."""


def row_shape(recipe: Recipe, name: str) -> tuple[int, ...]:
    """The shape of a row of an array."""
    return {"observation": recipe.shape, "action": (5,)}.get(name, ())


def shapes(recipe: Recipe, number: int, transitions: int) -> dict[str, tuple[int, ...]]:
    """The shapes of a shard's arrays."""
    episodes = len(recipe.episodes_of(number))
    rows = {"observation": transitions + episodes, "length": episodes, "world": episodes}
    return {name: (rows.get(name, transitions), *row_shape(recipe, name)) for name in DTYPES}


def write_shard(
    folder: Path, number: int, parts: Mapping[str, Sequence[Array]], *, compress: bool
) -> ShardRow:
    """Write a shard from arrays in parts, which are concatenated. Equal arrays make equal files.

    Raises:
        CompileError: PD613 if the place cannot be written, or the disk is full.
    """
    path = folder / shard_file(number)
    arrays: dict[str, Array | Parts | str] = {}
    for name, dtype in DTYPES.items():
        rows = [np.asarray(part, dtype) for part in parts[name]]
        arrays[name] = Parts(dtype, (sum(map(len, rows)), *rows[0].shape[1:]), rows)
    with replacing(path) as temporary:
        with temporary.open("w+b") as file:
            write_archive(file, arrays, LEVEL if compress else 0)
            file.flush()
            file.seek(0)
            os.fsync(file.fileno())
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        size = temporary.stat().st_size
    return ShardRow(number, digest, size, sum(map(len, parts["action"])))


@dataclass(frozen=True)
class Shard:
    """The arrays of a shard, as `DTYPES` and `shapes` have them; read-only."""

    arrays: dict[str, Array]
    loaded: int
    """Bytes of these arrays that are in memory rather than mapped."""

    @cached_property
    def starts(self) -> Array:
        """The first transition of each episode: int64 [episodes]. Its first observation is `starts` + its place."""
        length = self.arrays["length"].astype(np.int64)
        return np.cumsum(length) - length


def is_whole(folder: Path, row: ShardRow) -> bool:
    """True if a shard's file exists and has the size and digest of the manifest."""
    try:
        with open_regular(folder / row.file) as file:
            if os.fstat(file.fileno()).st_size != row.bytes:
                return False
            return hashlib.file_digest(file, "sha256").hexdigest() == row.sha256
    except OSError:
        return False


def open_shard(folder: Path, recipe: Recipe, row: ShardRow) -> Shard:
    """A shard, after checking every byte of it.

    Raises:
        CompileError: PD630, naming the shard and what is wrong with it.
    """
    path = folder / row.file
    with _damage(path):
        if not is_whole(folder, row):
            raise BadArchive("its size or its SHA-256 is another than the manifest's")
        shard = _read(path, shapes(recipe, row.number, row.transitions))
        check_episodes(shard.arrays, recipe)
    return shard


def read_episodes(folder: Path, recipe: Recipe, row: ShardRow) -> tuple[Array, Array]:
    """The arrays `length` and `world` of a shard, whose other bytes are neither read nor checked.

    Raises:
        CompileError: PD630, as `open_shard`.
    """
    path = folder / row.file
    with _damage(path):
        arrays = _read(path, shapes(recipe, row.number, row.transitions), only=("length", "world")).arrays
        _check_lengths(arrays["length"].astype(np.int64), recipe, row.transitions)
    return arrays["length"], arrays["world"]


def _damage(path: Path) -> AbstractContextManager[None]:
    return reporting_damage(f"the shard {path} is damaged", "the command that recorded it records it again")


def _read(path: Path, expected: dict[str, tuple[int, ...]], only: tuple[str, ...] = tuple(DTYPES)) -> Shard:
    """Some arrays of an archive. Raises if it does not have exactly the expected ones."""
    arrays: dict[str, Array] = {}
    loaded = 0
    whole = np.memmap(path, np.uint8, "r")
    with open_archive(path) as archive:
        if archive.headers.keys() != expected.keys():
            raise BadArchive(f"it must hold {', '.join(expected)}, and nothing else")
        for name in only:
            header, shape, dtype = archive.headers[name], expected[name], np.dtype(DTYPES[name])
            if (header.shape, header.dtype) != (shape, dtype.name):
                raise BadArchive(
                    f"`{name}` is {header.dtype} {list(header.shape)}, not {dtype} {list(shape)}"
                )
            if header.entry.compress_type == zipfile.ZIP_STORED:
                start = _data_offset(whole, header.entry) + header.start
                arrays[name] = np.ndarray(shape, dtype, buffer=whole, offset=start)
            else:
                arrays[name] = archive.read(name)
                loaded += header.size
    return Shard(arrays, loaded)


def _data_offset(whole: Array, entry: zipfile.ZipInfo) -> int:
    """The offset of a member's bytes, after its local header, whose name and extra field vary in length."""
    at = entry.header_offset
    name, extra = np.frombuffer(whole[at + 26 : at + 30].tobytes(), "<u2").tolist()
    return int(at + 30 + name + extra)


def _check_lengths(length: Array, recipe: Recipe, transitions: int) -> None:
    if length.min() < 1 or length.max() > recipe.actions or length.sum() != transitions:
        raise BadArchive("the lengths of its episodes do not fit")


def knows_ids(recipe: Recipe, observation: Array) -> bool:
    """True if the palette has all ids of observations, uint8 [n, C, H, W]."""
    known = np.zeros(256, bool)
    known[[int(number) for number in recipe.palette]] = True
    where = recipe.channels.index("element") if "element" in recipe.channels else 0
    rows = observation[:, where]
    return all(bool(known[rows[at : at + 256]].all()) for at in range(0, len(rows), 256))


def check_episodes(arrays: Mapping[str, Array], recipe: Recipe) -> None:
    """Check that episodes end where their lengths say, and that actions are in range. Raises BadArchive."""
    length, action = arrays["length"].astype(np.int64), arrays["action"]
    _check_lengths(length, recipe, len(action))
    ended = arrays["terminated"].astype(np.int64) + arrays["truncated"]
    last = np.zeros_like(ended)
    last[np.cumsum(length) - 1] = 1
    if not np.array_equal(ended, last):
        raise BadArchive("episodes do not end where their lengths say")
    if (action < 0).any() or (action >= np.array(recipe.action_nvec)).any():
        raise BadArchive("it has actions out of range")
    if (arrays["world"] < 0).any():
        raise BadArchive("it has worlds out of range")
