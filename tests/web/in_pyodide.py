"""What the test does in Pyodide and in CPython alike: commands, and the module of powderworld, as files in this folder."""

import sys
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

from powderdsl.cli.dispatch import main
from powderdsl.compiler import load, lower, shipped
from powderdsl.ir.segments import segments
from powderdsl.targets.wasm.source import wasm_module

COMMANDS = (
    "check powderworld --quick",
    "check broken.yaml --quick",
    "compile powderworld --emit model",
    "explain PD301",
)

for number, words in enumerate(COMMANDS):
    sys.argv = ["powderdsl", *words.split()]
    status: object = 0
    output = StringIO()
    with redirect_stdout(output), redirect_stderr(output):
        try:
            main()
        except SystemExit as ended:
            status = ended.code
    Path(f"output{number}").write_text(output.getvalue().replace(str(shipped("rules")), "rules"))
    Path(f"status{number}").write_text(str(status or 0))

(segment,) = segments(lower(load("powderworld")))
assert segment.planes is not None
Path("module.wasm").write_bytes(wasm_module(segment.planes, 64).code)
