"""Archives of arrays and checkpoints are known by what they claim before any of it takes memory."""

from __future__ import annotations

import hashlib
import resource
import zipfile
from collections import OrderedDict

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


def test_a_small_file_with_a_large_world_is_not_unpacked(tmp_path):
    sim = powderdsl.compile("core", backend="reference")
    powderdsl.save(sim.world(np.zeros((1, 4, 4), np.uint8)), tmp_path / "w.npz")
    with np.load(tmp_path / "w.npz") as data:
        arrays = dict(data)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    side = 12_000
    header = {"descr": "|u1", "fortran_order": False, "shape": (1, side, side)}
    with zipfile.ZipFile(tmp_path / "w.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        for name, value in arrays.items():
            with archive.open(f"{name}.npy", "w") as member:
                if name != "slot_element":
                    np.lib.format.write_array(member, value)
                    continue
                np.lib.format.write_array_header_1_0(member, header)
                for _ in range(side):
                    member.write(bytes(side))
    assert (tmp_path / "w.npz").stat().st_size < 1_000_000
    assert refused_codes(powderdsl.load_world, tmp_path / "w.npz", sim) == ["PD607"]
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


@pytest.mark.parametrize(
    ("words", "members"),
    [
        ("is not an array of numbers", {"x": np.array([None])}),
        ("is not an array of numbers", {"x": np.zeros(2, [("a", "i4")])}),
        ("is not an array of numbers", {"x": np.zeros(2, "S3")}),
        ("is not an array of numbers", {"x": np.array([1j])}),
        ("is not an array of numbers", {"x": np.array([1], ">i4")}),
        ("`b` is not in C order", {"b": np.ones((3, 2)).T}),
        ("more than 256", {str(number): np.zeros(1) for number in range(300)}),
    ],
)
def test_archives_of_anything_else_are_refused(words, members, tmp_path):
    np.savez(tmp_path / "a.npz", **members)
    with pytest.raises(BadArchive, match=words), open_archive(tmp_path / "a.npz"):
        pass


@pytest.mark.parametrize(
    "header",
    ["", "{}", "[1", "f(2)", "9" * 5000, "(" * 900, "{'descr': '<i4', 'fortran_order': 0, 'shape': 3}"],
    ids=range(7),
)
def test_damaged_headers_are_told_in_our_words(header, tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("x.npy", b"\x93NUMPY\1\0" + len(header).to_bytes(2, "little") + header.encode())
    with pytest.raises(BadArchive, match="`x` is not an array of numbers"), open_archive(tmp_path / "a.npz"):
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
    np.savez(tmp_path / "unpacked.npz", about=np.array("ä 🌍 {}", "U9"), **arrays)
    with (tmp_path / "ours.npz").open("wb") as file:
        write_archive(file, {"about": "ä 🌍 {}", **arrays})
    assert (tmp_path / "ours.npz").read_bytes() == (tmp_path / "numpy.npz").read_bytes()
    for path in (tmp_path / "ours.npz", tmp_path / "unpacked.npz"):
        with open_archive(path) as archive:
            assert archive.text("about") == "ä 🌍 {}"
            for name, value in arrays.items():
                found = archive.read(name)
                assert archive.headers[name].dtype == found.dtype == value.dtype
                assert (found.shape, found.tobytes()) == (value.shape, value.tobytes())
            with pytest.raises(BadArchive):
                archive.text("ids")
            with pytest.raises(BadArchive):
                archive.read("about")


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
    (tmp_path / "checkpoints").mkdir()
    digest = hashlib.sha256(CRAFTED[name]).hexdigest()[:16]
    (tmp_path / "checkpoints" / f"{3:012d}-{digest}.safetensors").write_bytes(CRAFTED[name])
    assert refused_codes(RunFolder(tmp_path, "toy", {}, {}).latest_checkpoint) == ["PD620"]
