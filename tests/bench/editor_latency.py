"""How long the language server takes to answer, as an editor sees it: `python -m tests.bench.editor_latency`.

A pack of 130 lines, and one of 311 lines with 20 tests, are edited on `powderworld`, a key at a time: the time until the mistakes are published,
until the outline is there too, until words are offered, and until one is explained, in milliseconds.
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

KEYS = 200

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
    """Type letters at random places of both packs, and print how long the answers take."""
    pack = universe_text(7)
    for text in (pack, pack + "tests:\n" + "".join(TEST.format(number=number) for number in range(20))):
        await type_letters(editor, text)


async def type_letters(editor: Editor, text: str) -> None:
    print(f"{len(text.splitlines())} lines")
    await editor.open(text)
    draw = random.Random(0)
    times: dict[str, list[float]] = {
        "mistakes": [],
        "mistakes and outline": [],
        "completion": [],
        "hover": [],
    }
    for _ in range(KEYS):
        at = draw.randrange(len(text))
        began = time.perf_counter()
        await editor.change(text[:at] + "a" + text[at:])
        times["mistakes"].append(editor.heard_at - began)
        times["mistakes and outline"].append(time.perf_counter() - began)
        line = draw.randrange(20, text.count("\n"))
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
            f"  {name}: median {1000 * median(values):.0f}, 95 % below {1000 * quantiles(values, n=20)[-1]:.0f} ms"
        )


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        edited(measure, Path(folder) / "pack.yaml", "--with", "powderworld")
