"""Archives of arrays and checkpoints are known by what they claim before any of it takes memory."""

from __future__ import annotations

import hashlib
import resource
import struct
import zipfile
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save

import powderdsl
from powderdsl.diagnostics import CompileError
from powderdsl.experiments.runs import STATE, RunFolder
from powderdsl.system.archives import BadArchive, open_archive, write_archive
from powderdsl.worlds.raster import MAX_CELLS
from tests.refusals import refused_codes


def codes(path: Path) -> list[str]:
    sim = powderdsl.compile("core", backend="reference")
    return refused_codes(powderdsl.load_world, path, sim)


def test_a_small_file_with_a_large_world_is_not_unpacked(tmp_path):
    sim = powderdsl.compile("core", backend="reference")
    powderdsl.save(sim.world(np.zeros((1, 4, 4), np.uint8)), tmp_path / "w.npz")
    with np.load(tmp_path / "w.npz") as data:
        arrays = dict(data)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    side = 12_000
    header = f"{{'descr': '|u1', 'fortran_order': False, 'shape': (1, {side}, {side}), }}".encode()
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    with zipfile.ZipFile(tmp_path / "w.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        for name, value in arrays.items():
            with archive.open(f"{name}.npy", "w") as member:
                if name != "slot_element":
                    np.lib.format.write_array(member, value)
                    continue
                member.write(b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header)
                for _ in range(side):
                    member.write(bytes(side))
    assert (tmp_path / "w.npz").stat().st_size < 1_000_000
    assert codes(tmp_path / "w.npz") == ["PD607"]
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # KiB


def test_worlds_that_could_not_be_loaded_are_not_saved(tmp_path):
    sim = powderdsl.compile("core", backend="reference")
    world = sim.world(np.zeros((1, 4, 4), np.uint8))
    count = MAX_CELLS // 16 + 1
    large = {name: value.expand(count, *value.shape[1:]) for name, value in world.state.items()}
    clock = [value.expand(count) for value in (world.seed, world.index, world.step)]
    many = powderdsl.World(sim, large, *clock)
    with pytest.raises(CompileError, match="PD607"):
        powderdsl.save(many, tmp_path / "w.npz")
    assert list(tmp_path.iterdir()) == []


def test_members_that_are_not_numbers_are_refused(tmp_path):
    for value in (
        np.array([None]),
        np.zeros(2, [("a", "i4")]),
        np.zeros(2, "S3"),
        np.array([1j]),
        np.array([1], ">i4"),
    ):
        np.savez(tmp_path / "a.npz", x=value)
        with pytest.raises(BadArchive), open_archive(tmp_path / "a.npz"):
            pass


def test_a_long_list_of_contents_is_not_read(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        for number in range(300):
            archive.writestr(f"{number}.npy", b"")
    with pytest.raises(BadArchive, match="more than 256"), open_archive(tmp_path / "a.npz"):
        pass


def test_archives_are_those_of_numpy(tmp_path):
    random = np.random.default_rng(1)
    arrays = {
        "ids": random.integers(0, 9, (3, 5, 7)).astype(np.uint8),
        "speed": random.normal(size=(2, 2, 400, 300)).astype(np.float32),
        "few": np.arange(4, dtype=np.int64),
        "flags": random.random((12, 1)) < 0.5,
    }
    np.savez_compressed(tmp_path / "numpy.npz", about=np.array("ä 🌍 {}"), **arrays)
    with (tmp_path / "ours.npz").open("wb") as file:
        write_archive(file, {"about": "ä 🌍 {}", **arrays})
    assert (tmp_path / "ours.npz").read_bytes() == (tmp_path / "numpy.npz").read_bytes()
    with open_archive(tmp_path / "ours.npz") as archive:
        assert archive.text("about") == "ä 🌍 {}"
        for name, value in arrays.items():
            found = archive.read(name)
            assert (found.dtype, found.shape, found.tobytes()) == (value.dtype, value.shape, value.tobytes())


def test_what_numpy_saves_is_read(tmp_path):
    value = np.arange(24, dtype="i4").reshape(2, 3, 4)
    np.savez(tmp_path / "a.npz", b=np.asfortranarray(value))
    with pytest.raises(BadArchive, match="`b` is not in C order"), open_archive(tmp_path / "a.npz"):
        pass
    np.savez(tmp_path / "a.npz", a=value, c=np.array("x", "U3"))
    with open_archive(tmp_path / "a.npz") as archive:
        assert archive.headers["a"].dtype == "int32"
        assert (archive.read("a") == value).all()
        assert archive.text("c") == "x"
        with pytest.raises(BadArchive):
            archive.text("a")
        with pytest.raises(BadArchive):
            archive.read("c")


# Checkpoints


def test_what_training_saves_is_read(tmp_path):
    shared = torch.arange(6).reshape(2, 3)
    weights = OrderedDict(
        a=shared, b=torch.ones(4)[1:3], c=shared, d=shared.T, e=torch.tensor(0.5), f=torch.zeros(0, 3)
    )
    state = {"model": weights, "recent": [1.0, None, "x", (1, True)], "optimizer": {0: {}, 1: {"step": 1}}}
    run = RunFolder(tmp_path, "toy", {}, {})
    run.save_checkpoint(3, state)
    found = run.latest_checkpoint()
    model = found.state.pop("model")
    assert found.state == {"recent": state["recent"], "optimizer": state["optimizer"]}
    assert list(model) == list(weights)
    assert all(
        torch.equal(model[name], value) and model[name].dtype == value.dtype
        for name, value in weights.items()
    )


def crafted(folder: Path, data: bytes) -> None:
    folder.mkdir()
    (folder / f"{3:012d}-{hashlib.sha256(data).hexdigest()[:16]}.safetensors").write_bytes(data)


def with_text(text: bytes) -> bytes:
    return save({"0": torch.ones(2), STATE: torch.frombuffer(bytearray(text), dtype=torch.uint8)})


def with_header(old: bytes, new: bytes) -> bytes:
    data = with_text(b"[]")
    length = int.from_bytes(data[:8], "little")
    header = data[8 : 8 + length].replace(old, new)
    assert header != data[8 : 8 + length]
    return len(header).to_bytes(8, "little") + header + data[8 + length :]


CRAFTED = {
    "empty": b"",
    "no tensors": b"x" * 100,
    "a pickle": b"\x80\x02cposix\nsystem\nX\x04\0\0\0true\x85R.",
    "a long header": (1 << 60).to_bytes(8, "little") + b"{}",
    "no state": save({"0": torch.ones(2)}),
    "a state that is not text": save({STATE: torch.full((3,), 1e9)}),
    "no JSON": with_text(b"{"),
    "deep nesting": with_text(b"[" * 100_000 + b"]" * 100_000),
    "many values": with_text(b"[" + b"0," * (1 << 20) + b"0]"),
    "a tensor that is not there": with_text(b'{"tensor": "1"}'),
    "a key that is a list": with_text(b'{"dict": [[[], 1]]}'),
    "no pairs": with_text(b'{"dict": 7}'),
    "a tensor without its bytes": with_header(b"[2]", b"[2000000000]"),
    "bytes beyond the end": with_header(b'"data_offsets":[0,', b'"data_offsets":[9999,'),
}


@pytest.mark.parametrize("name", CRAFTED)
def test_a_crafted_checkpoint_is_refused(name, tmp_path):
    crafted(tmp_path / "checkpoints", CRAFTED[name])
    assert refused_codes(RunFolder(tmp_path, "toy", {}, {}).latest_checkpoint) == ["PD620"]
