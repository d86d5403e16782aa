"""How long the language server takes to answer, as an editor sees it: `python -m tests.bench.editor_latency`.

A pack of 311 lines, 20 tests among them, is edited on `powderworld`, a key at a time: the time until its mistakes are published, until words are
offered, and until one is explained, in milliseconds.
"""

from __future__ import annotations

import random
import tempfile
import time
from pathlib import Path
from statistics import median, quantiles

from lsprotocol import types as lsp

from powderdsl.universes import universe_text
from tests.editing.test_lsp import Editor, edited

KEYS = 60

TEST = """\
  - a wall stays {number}:
      given: |
        # . #
        # # #
      after: 1 step
      expect: |
        # . #
        # # #
      always: [count(wall in world) == 5 or not wall]
"""


async def measure(editor: Editor) -> None:
    """Type letters at random places, and print how long the answers take."""
    text = universe_text(7) + "tests:\n" + "".join(TEST.format(number=number) for number in range(20))
    await editor.open(text)
    draw = random.Random(0)
    times: dict[str, list[float]] = {"mistakes": [], "completion": [], "hover": []}
    for _ in range(KEYS):
        at = draw.randrange(len(text))
        began = time.perf_counter()
        await editor.change(text[:at] + "a" + text[at:])
        times["mistakes"].append(time.perf_counter() - began)
        line = draw.randrange(20, 250)
        where = {"text_document": editor.document, "position": lsp.Position(line, 10)}
        for name, ask, params in (
            ("completion", editor.client.text_document_completion_async, lsp.CompletionParams(**where)),
            ("hover", editor.client.text_document_hover_async, lsp.HoverParams(**where)),
        ):
            began = time.perf_counter()
            await ask(params)
            times[name].append(time.perf_counter() - began)
    for name, values in times.items():
        print(
            f"{name}: median {1000 * median(values):.0f}, 95 % below {1000 * quantiles(values, n=20)[-1]:.0f} ms"
        )


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        edited(measure, Path(folder) / "pack.yaml", "--with", "powderworld")
