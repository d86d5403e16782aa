"""Checkpoints: files that are written whole or not at all, with their digest in their names."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from powderdsl.system.reading import parse_json, read_bytes
from powderdsl.system.writing import failure, not_writable, replacing

if TYPE_CHECKING:
    from torch import Tensor

NAME = re.compile(r"([0-9]{12})-([0-9a-f]{16})\.safetensors")
STATE = "state"
"""The tensor whose bytes are the state as JSON, with the names of the other tensors in their places."""

MAX_BYTES = 1 << 33


@dataclass(frozen=True)
class Checkpoint:
    """What was saved after `step` steps: nested dicts, lists and tuples of tensors, numbers, text and None."""

    step: int
    state: Any
    path: Path


def save_checkpoint(folder: Path, step: int, state: Any) -> Path:
    """Write a checkpoint, and remove all others but the last one before it. Returns its path.

    Raises:
        CompileError: PD613 if the folder cannot be written to, or the disk is full.
    """
    data = _encoded(state)
    path = folder / f"{step:012d}-{_digest(data)}.safetensors"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            temporary.write_bytes(data)
    except OSError as error:
        raise not_writable(path, error) from None
    before = [old for number, _, old in _named(folder) if number < step]
    for _, _, other in _named(folder):
        # Later ones are left by a run that had to go back; they must not be taken for newer.
        if other not in (path, *before[:1]):
            other.unlink(missing_ok=True)
    return path


def latest_checkpoint(folder: Path) -> Checkpoint | None:
    """The newest checkpoint whose digest is right; None if there is none. Damaged ones are passed over.

    Loading executes nothing: only tensors and plain values are read, and they take no more memory than the file.

    Raises:
        CompileError: PD620 for a file that is whole and holds something else.
    """
    for step, digest, path in _named(folder):
        try:
            data = read_bytes(path, MAX_BYTES)
        except OSError:
            continue
        if _digest(data) == digest:
            try:
                return Checkpoint(step, _decoded(data), path)
            except Exception as error:  # a crafted file raises whatever it likes
                why = (str(error).strip().partition("\n")[0] or type(error).__name__)[:300]
                raise failure("PD620", f"{path} is not a checkpoint of a run", notes=(why,)) from None
    return None


def _encoded(state: Any) -> bytes:
    import torch
    from safetensors.torch import save

    tensors: dict[str, Tensor] = {}
    text = json.dumps(_packed(state, tensors)).encode()
    return save({**tensors, STATE: torch.frombuffer(bytearray(text), dtype=torch.uint8)})


def _decoded(data: bytes) -> Any:
    from safetensors.torch import load

    tensors = load(data)
    return _unpacked(parse_json(bytes(tensors[STATE].numpy())), tensors)


def _packed(value: Any, tensors: dict[str, Tensor]) -> Any:
    """A state as JSON has it: what is neither a list nor a plain value becomes a pair of its kind and contents."""
    import torch

    match value:
        case torch.Tensor():
            name = str(len(tensors))
            # safetensors takes no tensors that share memory, as those of a network may.
            tensors[name] = value.detach().cpu().clone(memory_format=torch.contiguous_format)
            return {"tensor": name}
        case dict():
            return {"dict": [[key, _packed(item, tensors)] for key, item in value.items()]}
        case tuple():
            return {"tuple": [_packed(item, tensors) for item in value]}
        case list():
            return [_packed(item, tensors) for item in value]
    return value


def _unpacked(value: Any, tensors: dict[str, Tensor]) -> Any:
    match value:
        case {"tensor": name}:
            return tensors[name]
        case {"dict": pairs}:
            return {key: _unpacked(item, tensors) for key, item in pairs}
        case {"tuple": items}:
            return tuple(_unpacked(item, tensors) for item in items)
        case list():
            return [_unpacked(item, tensors) for item in value]
    return value


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


def _named(folder: Path) -> list[tuple[int, str, Path]]:
    """Step, digest and path of all checkpoints, the newest first."""
    matches = [(NAME.fullmatch(path.name), path) for path in sorted(folder.glob("*"))]
    return sorted(((int(match[1]), match[2], path) for match, path in matches if match), reverse=True)
