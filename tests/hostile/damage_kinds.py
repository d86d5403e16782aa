"""Damaged and hostile files of every kind that powderdsl reads. What a seed makes of a valid file is always the same."""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import torch
from safetensors.torch import load, save

from powderdsl.cli.commands.study import commands
from powderdsl.experiments.runs import STATE
from powderdsl.experiments.studies.run import StudyRun
from powderdsl.experiments.studies.study import load_study
from tests.cli.commands import PACK
from tests.cli.endless import TASK as DIG
from tests.cli.test_new_and_test import TESTS
from tests.studies.test_parts import STUDY

TEXTS = (
    "\x1b]0;owned\x07",
    "\x1b[2J\x1b[31mred",
    "\x9b31m",
    "\u202egnp",
    "a\nerror[PD901]: b",
    "a\0b",
    "\ud7ff\ufeff\u200b",
    "../outside/victim.json",
    "/etc/passwd",
    "~/x.yaml",
    "x" * 100_000,
    "wаter",
    "",
)
"""Words that want more than to be read. OUTSIDE is a file beside the folder."""
NUMBERS = (
    "-1",
    "0",
    "1e999",
    "nan",
    "9" * 400,
    "4294967296",
    "1000000000",
    "0x10",
    "1_000",
    "1.5",
    "2147483648",
)
VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 2**31, 2**63, 10**30, 1e308, -0.0, float("nan"), float("inf"), [], {}, [[]], {"a": {}}, *TEXTS,
)  # fmt: skip


def bytes_damaged(data: bytes, random: Random) -> bytes:
    """Some bytes turned, lost, doubled or made up; or all of them."""
    if random.random() < 0.05:
        return random.choice(
            (b"", b"\0" * 100, b"\xff" * 1000, b"PK\3\4", b"\x89PNG\r\n\x1a\n", random.randbytes(300))
        )
    found = bytearray(data)
    for _ in range(random.randint(1, 6)):
        at, length = random.randrange(len(found) + 1), random.choice((1, 1, 4, 30))
        match random.randrange(5):
            case 0 if at < len(found):
                found[at] ^= 1 << random.randrange(8)
            case 1:
                del found[at : at + length]
            case 2:
                found[at:at] = random.randbytes(length)
            case 3:
                found[at:at] = found[at : at + length]
            case 4 if random.random() < 0.3:
                del found[at:]
            case _:
                found[at : at + length] = b"\xff" * len(found[at : at + length])
    return bytes(found)


def json_damaged(data: bytes, random: Random) -> bytes:
    """A value somewhere in a JSON text exchanged, lost or made up; deep and long ones."""
    match random.randrange(12):
        case 0:
            return b"[" * 100_000 + b"]" * 100_000
        case 1:
            return b"[" + b"[]," * 1_300_000 + b"[]]"
        case 2:
            return bytes_damaged(data, random)
    tree = json.loads(data)
    for _ in range(random.randint(1, 3)):
        at: Any = tree
        while isinstance(at, (dict, list)) and at:
            key = random.choice([*at] if isinstance(at, dict) else range(len(at)))
            inner = at[key]
            if not isinstance(inner, (dict, list)) or not inner or random.random() < 0.4:
                match random.randrange(4):
                    case 0:
                        del at[key]
                    case 1 if isinstance(at, dict):
                        at[random.choice(TEXTS)] = inner
                    case _:
                        at[key] = random.choice(VALUES)
                break
            at = inner
    return json.dumps(tree).encode("utf-8", "surrogatepass")


def yaml_damaged(data: bytes, random: Random) -> bytes:
    """Words exchanged for hostile ones, lines lost or doubled, depth and length."""
    text = data.decode()
    for _ in range(random.randint(1, 3)):
        words = [*re.finditer(r"[\w$./+#-]+", text)]
        lines = text.splitlines(keepends=True)
        match random.randrange(9):
            case 0 | 1 if words:
                word = random.choice(words)
                text = text[: word.start()] + json.dumps(random.choice(TEXTS)) + text[word.end() :]
            case 2 | 3 if words:
                word = random.choice(words)
                text = text[: word.start()] + random.choice(NUMBERS) + text[word.end() :]
            case 4 if lines:
                del lines[random.randrange(len(lines))]
                text = "".join(lines)
            case 5 if lines:
                at = random.randrange(len(lines))
                text = "".join([*lines[:at], lines[at] * random.choice((2, 2000)), *lines[at:]])
            case 6 if words:
                word, depth = random.choice(words), random.choice((20, 1000))
                nest = random.choice(("[]", "()", "{}"))
                text = text[: word.start()] + nest[0] * depth + word[0] + nest[1] * depth + text[word.end() :]
            case 7 if words:
                one, other = random.choice(words), random.choice(words)
                text = text[: one.start()] + other[0] + text[one.end() :]
            case _:
                return bytes_damaged(text.encode("utf-8", "surrogatepass"), random)
    return text.encode("utf-8", "surrogatepass")


# Archives of arrays


def npy(descr: str, shape: tuple[Any, ...] | str, data: bytes) -> bytes:
    """An array's file with any header."""
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(text)) + text + data


def npz_damaged(data: bytes, random: Random) -> bytes:
    """Arrays that claim other sizes and types, bombs, and words about them that are not true."""
    if random.random() < 0.3:
        return bytes_damaged(data, random)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = random.choice([*members])
    match random.randrange(9):
        case 0:
            side = random.choice((5000, 30_000, 1 << 40, 0, -1, "'x'", "[]"))
            members[name] = npy("'|u1'", f"({side}, {side}, 1)", members[name][128:])
        case 1:
            members[name] = npy("'|u1'", (1, 6000, 6000), bytes(36_000_000))
        case 2:
            descr = random.choice(
                ("'|O'", "'<f8'", "'<U1000000'", "'|V9'", "[('a', '<i4')]", "'|S3'", "'<i8'", "'<c16'")
            )
            members[name] = npy(descr, (1, 8, 8), random.randbytes(1024))
        case 3:
            members[name] = bytes_damaged(members[name], random)
        case 4:
            del members[name]
        case 5:
            members |= {f"slot_{number}.npy": npy("'|u1'", (1, 8, 8), bytes(64)) for number in range(3000)}
        case 6:
            members[random.choice(("slot_x.npy", "../../outside/victim.json", "\x1b[2J.npy"))] = members[name]
        case 7:
            about = json.dumps(
                {"format": 1, "ruleset": random.choice(TEXTS), "palette": random.choice(VALUES)}
            )
            deep = "[" * 100_000 + "]" * 100_000
            text = np.array(random.choice((about, deep, "1" * 10_000, "{}", "")))
            members["about.npy"] = npy(f"'{text.dtype.str}'", (), text.tobytes())
        case 8:
            members[name] = npy("'<i8'", (1,), struct.pack("<q", -(2**63)))
    out = io.BytesIO()
    with zipfile.ZipFile(
        out, "w", random.choice((zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED, zipfile.ZIP_BZIP2))
    ) as archive:
        for member, value in members.items():
            archive.writestr(member, value)
    return out.getvalue()


def png_damaged(data: bytes, random: Random) -> bytes:
    """Chunks that claim other sizes, bombs in texts and profiles, chunks out of order."""
    if random.random() < 0.4:
        return bytes_damaged(data, random)
    chunks, at = [], 8
    while at < len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    match random.randrange(5):
        case 0:
            side = [random.choice((0, 1, 5000, 60_000, 2**31 - 1)) for _ in range(2)]
            chunks[0] = (b"IHDR", struct.pack(">II", *side) + chunks[0][1][8:])
        case 1:
            kinds = bytes(random.choice((0, 1, 2, 3, 4, 6, 8, 16, 255)) for _ in range(5))
            chunks[0] = (b"IHDR", chunks[0][1][:8] + kinds)
        case 2:
            bomb = zlib.compress(bytes(60_000_000))
            chunks.insert(
                1,
                random.choice(
                    [(b"zTXt", b"a\0\0" + bomb), (b"iCCP", b"a\0\0" + bomb), (b"iTXt", b"a\0\1\0\0\0" + bomb)]
                ),
            )
        case 3:
            random.shuffle(chunks)
        case 4:
            chunks[1:1] = [(b"tEXt", b"a\0" + bytes(1000))] * 2000
    out = b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in chunks
    )
    return data[:8] + out


def checkpoint_damaged(data: bytes, random: Random) -> bytes:
    """States of other types, tensors that claim other sizes, a pickle in its place."""
    tensors = load(data)
    match random.randrange(7):
        case 0:
            return bytes_damaged(data, random)
        case 1:
            return b"\x80\x02cposix\nsystem\nX\x0b\0\0\0touch owned\x85R."
        case 2:
            shape = random.choice([(), (0,), (3, 0, 1 << 40), (7,)])
            zeros = torch.zeros(shape, dtype=random.choice([torch.bool, torch.bfloat16]))
            return save(tensors | {random.choice(sorted(tensors)): zeros})
        case 3 | 4:
            length = int.from_bytes(data[:8], "little")
            header = json.loads(data[8 : 8 + length])
            entry = header[random.choice(sorted(header))]
            sizes = [[10**9], [2**40, 2**40], [0, 10**12]]
            entry[random.choice(sorted(entry))] = random.choice([*VALUES, *sizes])
            changed = json.dumps(header).encode()
            return len(changed).to_bytes(8, "little") + changed + data[8 + length :]
        case 5:
            text = bytes_damaged(bytes(tensors[STATE].numpy()), random)
        case _:
            pairs = {"dict": [["policy", 1]]}, {"dict": [["model", {"dict": []}]]}
            values = [json.dumps(value).encode() for value in ([], {}, "x", 7, {"dict": 7}, *pairs)]
            text = random.choice([*values, b"[" * 200_000, b'{"tuple":[' * 5000 + b"]}" * 5000])
    return save(tensors | {STATE: torch.frombuffer(bytearray(text), dtype=torch.uint8)})


# Kinds


@dataclass(frozen=True)
class Kind:
    """Files of one kind: how many of 2,000, the command that reads them, what is damaged, and how."""

    name: str
    many: int
    words: tuple[str, ...]
    pattern: str
    change: Callable[[bytes, Random], bytes]
    after: Callable[[Path], None] = lambda folder: None


def _renamed(folder: Path) -> None:
    """Give checkpoints the names that their digests ask for."""
    for path in sorted(folder.glob("*/checkpoints/*.safetensors")):
        if path.is_file():
            digest = hashlib.sha256(path.read_bytes()).hexdigest()[:16]
            path.rename(path.with_name(f"{path.name[:12]}-{digest}.safetensors"))


def _signed(folder: Path) -> None:
    """Shards that their manifest vouches for."""
    path = folder / "data" / "dataset.json"
    try:
        data = json.loads(path.read_bytes())
        for row in data["shards"]:
            place = folder / "data" / f"shard-{row['number']:06d}.npz"
            if not place.is_file():  # a pipe or a device has no end
                continue
            shard = place.read_bytes()
            row["sha256"], row["bytes"] = hashlib.sha256(shard).hexdigest(), len(shard)
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return
    path.write_text(json.dumps(data))


SMALL = ("--backend", "reference", "--steps", "1", "--out", "out.png")
KINDS = (
    Kind("rules", 450, ("check", "grit.yaml+core"), "grit.yaml", yaml_damaged),
    Kind("tests of rules", 60, ("test", "core+grit.yaml", "--examples", "2", "--no-keep"), "grit.yaml", yaml_damaged),
    Kind("ruleset", 60, ("show", "pair.yaml"), "pair.yaml", yaml_damaged),
    Kind("world", 250, ("run", "core+sand", "--world", "world.npz", *SMALL), "world.npz", npz_damaged),
    Kind("picture", 160, ("run", "core+sand", "--world", "world.png", *SMALL), "world.png", png_damaged),
    Kind("drawing", 80, ("run", "core+sand", "--world", "world.txt", *SMALL), "world.txt", bytes_damaged),
    Kind("scene", 220, ("render", "core+sand", "--world", "scene.yaml", "--out", "out.png"), "scene.yaml", yaml_damaged),
    Kind("task", 220, ("check", "dig.yaml"), "dig.yaml", yaml_damaged),
    Kind("study", 160, ("study", "study.yaml", "--dry-run"), "study.yaml", yaml_damaged),
    Kind("a study's results", 120, ("study", "collect", "results", "--seeds", "1"), "results/study.json", json_damaged),
    Kind("values in them", 80, ("study", "collect", "results", "--seeds", "1"), "results/done/*=100,*.json", json_damaged),
    Kind("dataset", 120, ("record", "--verify", "data"), "data/dataset.json", json_damaged),
    Kind("shards", 80, ("record", "--verify", "data"), "data/shard-000000.npz", npz_damaged, _signed),
    Kind("agent", 60, ("evaluate", "ppo", "--episodes", "1", "--policies", "trained"), "ppo/run.json", json_damaged),
    Kind("agent's checkpoint", 80, ("evaluate", "ppo", "--episodes", "1", "--policies", "trained"), "ppo/checkpoints/*.safetensors", checkpoint_damaged, _renamed),
    Kind("world model", 50, ("wm", "eval", "wm", "--worlds", "1", "--split", "test"), "wm/run.json", json_damaged),
    Kind("its checkpoint", 50, ("wm", "eval", "wm", "--worlds", "1", "--split", "test"), "wm/checkpoints/*.safetensors", checkpoint_damaged, _renamed),
)  # fmt: skip


def damage(kind: Kind, folder: Path, seed: int) -> str:
    """Damage the file of a kind in a folder; how, in a word."""
    random = Random(f"{kind.name} {seed}")
    how, path = "damaged", sorted(folder.glob(kind.pattern))[0]
    if random.random() < 0.04:
        how = _no_file(path, random, folder)
    else:
        path.write_bytes(kind.change(path.read_bytes(), random))
    kind.after(folder)
    return how


def _no_file(path: Path, random: Random, folder: Path) -> str:
    """Put something else in a file's place."""
    path.unlink()
    how = random.choice(("pipe", "folder", "device", "link", "loop"))
    match how:
        case "pipe":
            os.mkfifo(path)
        case "folder":
            path.mkdir()
        case "device":
            path.symlink_to("/dev/zero")
        case "link":
            path.symlink_to(folder.parent / "outside" / "victim.json")
        case "loop":
            path.symlink_to(path.name)
    return how


def _results(folder: Path) -> None:
    """The results of a study, two runs that are done."""
    study = load_study(str(folder / "study.yaml"), commands())
    StudyRun(study, folder / "results", "small").prepare()
    (folder / "results" / "done").mkdir()
    for point in study.points("small", 1):
        done = folder / "results" / "done" / f"{point.name}.json"
        done.write_text('{"trained": {"splits": {"test": {"trained": {"mean": 2.5}}}}}', encoding="utf-8")


def make_valid(folder: Path, run: Callable[..., None]) -> None:
    """A folder with a valid file of each kind. `run` runs a command there."""
    folder.mkdir()
    (folder / "grit.yaml").write_text(GRIT, encoding="utf-8")
    (folder / "pair.yaml").write_text("ruleset: pair\nabout: Two packs.\npacks: [core, grit]\nslots: 32\n")
    (folder / "world.txt").write_text("....\n.##.\n....\n")
    (folder / "scene.yaml").write_text(SCENE)
    (folder / "dig.yaml").write_text(TASK)
    (folder / "study.yaml").write_text(STUDY.replace("sand-pushing", "dig.yaml"))
    _results(folder)
    run("run", "core+sand", "--size", "8", "--steps", "1", "--backend", "reference", "--out", "world.npz")
    run("render", "core+sand", "--world", "scene.yaml", "--scale", "1", "--out", "world.png")
    run("record", "dig.yaml", "--out", "data", "--episodes", "4", "--shard", "2", "--backend", "torch")
    tiny = ("--backend", "torch", "--preset", "small")
    run("train", "dig.yaml", *tiny, "--envs", "4", "--rollout", "3", "--batch", "12", "--steps", "12", "--features", "8", "--run", "ppo")  # fmt: skip
    run("wm", "train", "dig.yaml", *tiny, "--iterations", "2", "--batch", "2", "--width", "2", "--worlds", "4", "--buffer", "8", "--refresh", "2", "--run", "wm")  # fmt: skip
    for run_folder in ("ppo", "wm"):
        shutil.rmtree(folder / run_folder / "tensorboard", ignore_errors=True)
        about = folder / run_folder / "run.json"
        about.write_text(about.read_text().replace(str(folder) + "/", ""))


GRIT = (
    PACK.replace("200", "20")
    + TESTS
    + """\
fields: {heat: {type: 0..9, at: place}}
invariants: [count(wall) never changes]
"""
)
SCENE = """\
scene: yard
about: A heap in a frame.
size: [16, 16]
fill: empty
draw:
  - box sand rows 2:6 columns 3:9
  - disk sand at (10, 10) radius 3
  - line wall from (0, 0) to (15, 15) width 1
  - frame wall
"""
TASK = (
    DIG
    + """\
knobs: {lines: {default: 1, range: 0..9, about: half the side}}
regions: {middle: box rows 2:6 columns 2:6}
generate:
  - square sand at (4, 4) half lines + 1
  - scatter wall chance 10%
"""
)
