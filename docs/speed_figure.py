"""Draws docs/images/speed.png: what `powderdsl bench powderworld --batch 32` measures here, backend by backend."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from statistics import median

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt

BACKENDS = ("torch-cells", "torch", "wasm", "native")


def main() -> None:
    """Measure and draw."""
    words = [word for name in BACKENDS for word in ("--backend", name)]
    command = [sys.executable, "-m", "powderdsl", "bench", "powderworld", "--batch", "32", *words, "--json"]
    results = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
    times = {
        cell["backend"]: 1e6
        * median(cell["round_processor_seconds"])
        / (cell["steps_per_call"] * cell["calls_per_round"] * 32)
        for cell in results["cells"]
    }
    print(results["machine"], times)
    values = [times[name] for name in reversed(BACKENDS)]
    figure, axis = plt.subplots(figsize=(7.5, 2.0))
    bars = axis.barh(BACKENDS[::-1], values, color="#2563b0")
    axis.bar_label(bars, [f"{value:,.0f}" for value in values], padding=4)
    axis.set_xscale("log")
    axis.set_xlim(5, max(values) * 3)
    axis.set_xlabel("µs per step of a busy 64×64 world, one core, 32 worlds (log scale)")
    axis.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    figure.savefig(Path(__file__).with_name("images") / "speed.png", dpi=100)


if __name__ == "__main__":
    main()
