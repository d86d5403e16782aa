"""Worlds in files, for a module that runs without powderdsl: `host.mjs` steps them in Node.js."""

from __future__ import annotations

import hashlib
import json
import subprocess
from pathlib import Path
from typing import Any

from powderdsl.targets.wasm.program import WasmState

HOST = Path(__file__).with_name("host.mjs")


def write_job(folder: Path, sim: Any, world: Any, steps: int) -> None:
    """Write a world that the backend `wasm` has stepped, and what `host.mjs` does with it. It also needs `module.wasm`."""
    import torch

    assert isinstance(world.state, WasmState)
    instance, (batch, rows, _) = world.state.instance, world.ids.shape
    calls = []
    for name, value in world.state.items():
        (folder / name).write_bytes(value.contiguous().numpy().tobytes())
        pieces = instance.transfers(name, value.itemsize, value.shape, 0)
        calls += [{"slot": name, "numbers": numbers} for numbers in pieces]
    clock = torch.stack([world.seed, world.index, world.step])
    inputs = instance.input_bytes(sim.parameters({}, batch), batch)
    (folder / "inputs").write_bytes(clock.numpy().tobytes() + inputs)
    job = {"worlds": batch, "rows": rows, "steps": steps, "calls": calls}
    (folder / "job.json").write_text(json.dumps(job), encoding="utf-8")


def hashes_in_v8(node: str, folder: Path) -> dict[str, str]:
    """The hash of each slot after the job of a folder."""
    done = subprocess.run([node, str(HOST), str(folder)], capture_output=True, text=True, check=True)
    found: dict[str, str] = json.loads(done.stdout)
    return found


def hashes(world: Any) -> dict[str, str]:
    """The hash of each slot of a world."""
    state = world.state.items()
    return {name: hashlib.sha256(value.contiguous().numpy().tobytes()).hexdigest() for name, value in state}
