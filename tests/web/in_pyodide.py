"""What the test does in Pyodide and in CPython alike: commands, a module, and worlds of powderworld, as files in this folder."""

import re
import sys
from contextlib import redirect_stderr, redirect_stdout
from hashlib import sha256
from io import StringIO
from pathlib import Path

from powderdsl.arrays import np
from powderdsl.cli.dispatch import main
from powderdsl.compiler import load, lower, parts
from powderdsl.simulation.simulator import Simulator
from powderdsl.syntax.sources import shipped
from powderdsl.system.cache import Memo
from powderdsl.targets.array_kind import ArrayKind
from powderdsl.targets.wasm.source import wasm_module
from powderdsl.tasks.shipped import load_task
from powderdsl.tasks.tensors.generator import StartWorlds
from powderdsl.worlds.scene import draw_start, find_scene
from powderdsl.worlds.store import load_world, save
from powderdsl.worlds.strewn import strew

COMMANDS = (
    "check powderworld --quick",
    "check broken.yaml --quick",
    "check life",
    "test life --examples 40",
    "prove powderworld never (wood and momentum != 0)",
    "prove life == life",
    "compile powderworld --emit model",
    "explain PD301",
    "trace powderworld --world garden --at 10,10 --step 5",
)
STEPS = 200

for number, words in enumerate(COMMANDS):
    sys.argv = ["powderdsl", *words.split()]
    status: object = 0
    output = StringIO()
    with redirect_stdout(output), redirect_stderr(output):
        try:
            main()
        except SystemExit as ended:
            status = ended.code
    text = output.getvalue().replace(str(shipped("rules")), "rules")
    Path(f"output{number}").write_text(re.sub(r"in \d+ s\b", "in a while", text))
    Path(f"status{number}").write_text(str(status or 0))

memo = Memo()
model = load("powderworld")
(part,) = parts(lower(model, memo), memo)
assert part.planes is not None
Path("module.wasm").write_bytes(wasm_module(part.planes, 64, memo=memo).code)

sim = Simulator(model, "wasm", tensors=False, memo=memo)
ids = np.frombuffer(Path("ids").read_bytes(), np.uint8).reshape(2, 64, 64)
velocity = np.frombuffer(Path("velocity").read_bytes(), np.float32).reshape(2, 2, 64, 64)
world = sim.step(sim.replace(sim.world(ids, seed=3), velocity=velocity), STEPS)
hashes = [f"{name} {sha256(value.tobytes()).hexdigest()}\n" for name, value in sorted(world.state.items())]
Path("hashes").write_text("".join(hashes))

# Worlds that are drawn, scattered, made for tasks, saved and loaded
save(world, "world.npz")
again = sim.step(load_world("world.npz", sim), 5, params={"water.melt": 0.5}, passes=sim.passes[::2])
Path("world.npz").unlink()
drawn = draw_start(find_scene("garden"), model, size=(40, 70)).ids
scattered = strew(model, (33, 20), 2, 7)
painted = sim.paint(sim.world(scattered), where=scattered > 2, element="sand", velocity=(1, 2.5))
made = StartWorlds(load_task("sort-sand-and-stone"), "train", ArrayKind()).make(np.array([5, 9], np.int64))
arrays = [*again.state.values(), again.step, drawn, scattered, *painted.state.values(), made.ids]
Path("worlds").write_text("".join(f"{sha256(value.tobytes()).hexdigest()}\n" for value in arrays))
