"""How long it takes in Pyodide from an edited rule file to the first step of a world. `page_table.py` runs it.

Seconds are processor time of the thread that does everything, which other programs hardly change, and by the clock.
"""

import json
import time
from pathlib import Path

from js import cpu

begin, began = cpu(), time.perf_counter()
from powderdsl.arrays import np  # noqa: E402
from powderdsl.compiler import load_with_diagnostics  # noqa: E402
from powderdsl.simulation.simulator import Simulator  # noqa: E402
from powderdsl.syntax.parse import parser  # noqa: E402
from powderdsl.syntax.sources import shipped  # noqa: E402
from powderdsl.system.cache import Memo  # noqa: E402

REPEATS = 5
EDITS = {
    "freezing": ("water.yaml", "count(ice) >= 3", "count(ice) >= {}"),
    "fire": ("fire.yaml", "count(fuel) == 0", "count(fuel) < {}"),
    "wind": ("wind.yaml", "0.95 *", "0.8{} *"),
}
"""Files, text in them, and what becomes of it, with another number each time."""
FOLDER = Path("rules")


def laps(memo: Memo) -> dict[str, float]:
    """Seconds from the files to a world that has stepped, by phases."""
    start, clock = cpu(), time.perf_counter()
    model, _ = load_with_diagnostics(FOLDER / "powderworld.yaml")
    loaded = cpu()
    sim = Simulator(model, "wasm", tensors=False, memo=memo)
    lowered = cpu()
    world = sim.step(sim.world(np.zeros((1, 64, 64), np.uint8), seed=1))
    assert world.ids.shape == (1, 64, 64)
    end = cpu()
    return {
        "parse and check": loaded - start,
        "lower": lowered - loaded,
        "plan, emit, instantiate, step": end - lowered,
        "all": end - start,
        "by the clock": time.perf_counter() - clock,
    }


def best(runs: list[dict[str, float]]) -> dict[str, float]:
    return min(runs, key=lambda one: one["all"])


load_with_diagnostics("life")
parser()
found = {"imports, grammar": {"all": cpu() - begin, "by the clock": time.perf_counter() - began}}
FOLDER.mkdir(exist_ok=True)
for path in shipped("rules").glob("*.yaml"):
    (FOLDER / path.name).write_bytes(path.read_bytes())
found["from scratch, the first time"] = laps(Memo())
found["from scratch"] = best([laps(Memo()) for _ in range(REPEATS)])
memo = Memo()
laps(memo)
for name, (file, before, after) in EDITS.items():
    runs, text = [], (FOLDER / file).read_text()
    for number in range(1, REPEATS + 1):
        changed = text.replace(before, after.format(number + 3), 1)
        assert changed != text
        (FOLDER / file).write_text(changed)
        runs.append(laps(memo))
    (FOLDER / file).write_text(text)
    found[f"one pass changed: {name}"] = best(runs)
found["nothing changed"] = best([laps(memo) for _ in range(REPEATS)])
Path("seconds.json").write_text(json.dumps(found))
