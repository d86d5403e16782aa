"""Modules that stand alone, in wasmtime; and jobs for hosts in JavaScript (`alone.mjs`)."""

from __future__ import annotations

import base64
import json
import shutil
import struct
import subprocess
import threading
from collections.abc import Sequence
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from powderdsl.model.state import slots
from powderdsl.model.types import Ruleset
from powderdsl.simulation.standalone import standalone_module
from powderdsl.targets.wasm.host import this_host
from powderdsl.testing.generators.cases import Start

JOBS = Path(__file__).with_name("alone.mjs")


class StandaloneWorld:
    """A module in wasmtime, with its fields by name."""

    def __init__(self, ruleset: Ruleset, size: tuple[int, int]):
        self.running = this_host()(standalone_module(ruleset, size))()
        self.call, self.size = self.running.call, size
        self.slots = {slot.name: (number, slot) for number, slot in enumerate(slots(ruleset)[1:])}

    def begin(self, ids: np.ndarray, seed: int) -> None:
        self.running.write(self.call("cells"), ids.astype(np.uint8).tobytes())
        self.call("begin", seed)

    def ids(self) -> np.ndarray:
        return self._read(self.call("show"), self.size, np.dtype(np.uint8))

    def field(self, name: str) -> np.ndarray:
        number, slot = self.slots[name]
        shape = self.size if slot.planes == 1 else (2, *self.size)
        return self._read(self.call("field", number), shape, np.dtype(slot.dtype))

    def take(self, name: str, values: np.ndarray) -> None:
        number, slot = self.slots[name]
        self.running.write(self.call("field", number), values.astype(slot.dtype).tobytes())
        self.call("take", number)

    def paint(self, element: int, *box: int) -> None:
        self.call("paint", element, *box)

    def set(self, name: str, component: int, box: Sequence[int], value: float) -> None:
        self.call("set", self.slots[name][0], component, *box, pattern(value))

    def parameter(self, number: int, value: float) -> None:
        self.call("parameter", number, pattern(value))

    def _read(self, at: int, shape: tuple[int, ...], dtype: np.dtype[Any]) -> np.ndarray:
        memory = self.running.read(at, int(np.prod(shape)) * dtype.itemsize)
        return np.frombuffer(memory, dtype).reshape(shape)


def pattern(value: float) -> int:
    """An f64 argument, as the host takes bits."""
    return int(struct.unpack("<Q", struct.pack("<d", value))[0])


def job(ruleset: Ruleset, start: Start, steps: int) -> dict[str, Any]:
    """One world for hosts in JavaScript."""
    (ids,), clock = start.ids, np.stack([start.seed, start.index, start.step]).astype(np.int64)
    return {
        "module": text(standalone_module(ruleset, ids.shape)),
        "cells": text(ids.tobytes()),
        "fields": {
            slot.name: text(start.fields[slot.name][0].astype(slot.dtype).tobytes())
            for slot in slots(ruleset)[1:]
            if slot.name in start.fields
        },
        "clock": text(clock.tobytes()),
        "params": [float(start.params[one.name][0]) for one in ruleset.params if start.params],
        "steps": steps,
    }


def text(data: bytes) -> str:
    return base64.b64encode(data).decode()


NODE = shutil.which("node")
CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium-headless-shell", "chromium", "google-chrome"))), None
)


def in_node(jobs: list[dict[str, Any]], folder: Path) -> Any:
    """The hashes of each job's world at its end."""
    file = folder / "jobs.json"
    file.write_text(json.dumps(jobs))
    return json.loads(subprocess.check_output([str(NODE), str(JOBS), str(file)]))


def screenshot(folder: Path, size: tuple[int, int]) -> Image.Image:
    """What Chromium shows of a folder's page after ten seconds of its own time."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(SimpleHTTPRequestHandler, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    file = folder / "page.png"
    options = ["--no-sandbox", "--disable-gpu", "--hide-scrollbars", f"--screenshot={file}"]
    options += [f"--window-size={size[1]},{size[0]}", "--virtual-time-budget=10000"]
    command = [str(CHROMIUM), *options, f"http://127.0.0.1:{server.server_port}/index.html"]
    try:
        subprocess.run(command, capture_output=True, check=True, timeout=120)
    finally:
        server.shutdown()
        server.server_close()
    return Image.open(file)
