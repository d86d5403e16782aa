"""The language server, as an editor talks to it: a client over stdio, in a process of its own."""

from __future__ import annotations

import asyncio
import json
import random
import re
import sys
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from powderdsl.editing.workspace import KIND
from tests.cli.commands import environment_with, powderdsl

pytest.importorskip("pygls", reason="needs pygls")
from lsprotocol import types as lsp
from pygls.exceptions import JsonRpcException
from pygls.lsp.client import LanguageClient

PACK = """\
pack: slime
about: Something that creeps.
needs: [core]
params:
  creep: {type: chance, default: 5%, about: how often it creeps}
elements:
  slime: {id: 40, color: "#55AA22", density: 3, about: it creeps}
passes:
  creep:
    about: It creeps down.
    after: [gravity]
    do:
      - slime swaps below if below is empty with chance creep
"""


class Editor:
    """A client with one open file."""

    def __init__(self, path: Path):
        self.path, self.version, self.text = path, 0, ""
        self.client = LanguageClient("test", "1")
        self.published: dict[str, list[Any]] = {}
        self.heard = asyncio.Event()
        self.heard_at = 0.0
        """When the mistakes of the open file came last."""

        @self.client.feature(lsp.TEXT_DOCUMENT_PUBLISH_DIAGNOSTICS)
        def published(params: Any) -> None:
            self.published[params.uri] = params.diagnostics
            self.heard_at = time.perf_counter() if params.uri == self.uri else self.heard_at
            self.heard.set()

    @property
    def uri(self) -> str:
        return self.path.as_uri()

    async def start(self, *words: str) -> None:
        await self.client.start_io(sys.executable, "-m", "powderdsl", "lsp", *words, env=environment_with())
        root = self.path.parent.as_uri()
        await self.client.initialize_async(lsp.InitializeParams(lsp.ClientCapabilities(), root_uri=root))
        self.client.initialized(lsp.InitializedParams())

    async def open(self, text: str) -> list[Any]:
        self.heard.clear()
        self.text = text
        document = lsp.TextDocumentItem(self.uri, "yaml", 0, text)
        self.client.text_document_did_open(lsp.DidOpenTextDocumentParams(document))
        return await self.mistakes()

    async def change(self, text: str) -> list[Any]:
        """Another text; what the server says about it."""
        self.heard.clear()
        self.version, self.text = self.version + 1, text
        document = lsp.VersionedTextDocumentIdentifier(self.version, self.uri)
        whole = lsp.TextDocumentContentChangeWholeDocument(text)
        self.client.text_document_did_change(lsp.DidChangeTextDocumentParams(document, [whole]))
        return await self.mistakes()

    async def mistakes(self) -> list[Any]:
        await asyncio.wait_for(self.heard.wait(), 60)
        await self.client.text_document_document_symbol_async(lsp.DocumentSymbolParams(self.document))
        return [*self.published[self.uri]]

    @property
    def document(self) -> lsp.TextDocumentIdentifier:
        return lsp.TextDocumentIdentifier(self.uri)

    def at(self, text: str, skip: int = 0) -> lsp.Position:
        """The place behind a text."""
        offset = self.text.index(text) + len(text) - skip
        return lsp.Position(self.text.count("\n", 0, offset), offset - self.text.rfind("\n", 0, offset) - 1)

    async def labels(self, behind: str) -> list[str]:
        params = lsp.CompletionParams(self.document, self.at(behind))
        items = await self.client.text_document_completion_async(params)
        return [item.label for item in items]

    async def stop(self) -> None:
        await self.client.shutdown_async(None)
        self.client.exit(None)
        await self.client.stop()


def edited(use: Callable[[Editor], Awaitable[None]], path: Path, *words: str) -> None:
    """Use an editor, and end its server."""

    async def run() -> None:
        editor = Editor(path)
        await editor.start(*words)
        try:
            await use(editor)
        finally:
            await editor.stop()

    asyncio.run(run())


def test_mistakes_are_those_of_check_and_go_when_they_are_corrected(folder: Path) -> None:
    path = folder / "slime.yaml"

    async def use(editor: Editor) -> None:
        assert await editor.open(PACK) == []
        (mistake,) = await editor.change(PACK.replace("is empty", "is emtpy"))
        assert (mistake.code, mistake.range.start) == ("PD301", lsp.Position(12, 38))
        assert "did you mean `empty`?" in mistake.message
        params = lsp.CodeActionParams(editor.document, mistake.range, lsp.CodeActionContext([mistake]))
        (action,) = await editor.client.text_document_code_action_async(params)
        (edit,) = action.edit.changes[editor.uri]
        assert (edit.new_text, edit.range) == ("empty", mistake.range)
        assert await editor.change(PACK) == []
        assert not path.exists()
        assert await editor.change("on: push\njobs: [") == []  # YAML of others

    edited(use, path)


def test_words_are_completed_where_they_fit(folder: Path) -> None:
    async def use(editor: Editor) -> None:
        await editor.open(PACK)
        assert {"slime", "empty", "wall", "creep", "count", "below"} <= set(
            await editor.labels("- slime swaps ")
        )
        assert "slime" not in await editor.labels("core]\npar")
        assert {"kernels", "tests", "invariants"} <= set(await editor.labels("core]\npar"))
        assert await editor.labels('  slime: {id: 40, col') == [
            "id", "color", "color_by", "glyph", "about", "tags", "override",
        ]  # fmt: skip
        assert {"core", "water"} <= set(await editor.labels("needs: [co"))
        assert "gravity" in await editor.labels("after: [gra")
        await editor.change(PACK + "kernels:\n  near: {shape: disc(3), edges: w")
        assert await editor.labels("edges: w") == ["nothing", "wrap"]

    edited(use, folder / "slime.yaml")


def test_words_are_explained_found_and_renamed(folder: Path) -> None:
    path = folder / "slime.yaml"
    path.write_text(PACK)

    async def use(editor: Editor) -> None:
        await editor.open(PACK)

        async def hover(behind: str) -> str:
            params = lsp.HoverParams(editor.document, editor.at(behind))
            result = await editor.client.text_document_hover_async(params)
            return str(result.contents.value)

        assert "**element** `slime` of pack `slime`: it creeps" in await hover("- sli")
        assert "id 40, color #55AA22\n\nits number is constant" in await hover("- sli")
        assert "in quotes" in await hover("id: 40, col")
        assert "pack `core`" in await hover("below is em")

        params = lsp.DefinitionParams(editor.document, editor.at("below is em"))
        (target,) = await editor.client.text_document_definition_async(params)
        assert target.uri.endswith("/rules/core.yaml")
        assert target.range.start.line > 0

        # A pass and a parameter have the same name: each has its own places.
        for behind, lines in (("chance cre", [4, 12]), ("passes:\n  cre", [8])):
            where = {"text_document": editor.document, "position": editor.at(behind)}
            params = lsp.ReferenceParams(context=lsp.ReferenceContext(True), **where)
            places = await editor.client.text_document_references_async(params)
            assert [place.range.start.line for place in places] == lines

        renamed = lsp.RenameParams(editor.document, editor.at("- sli"), "goo")
        edit = await editor.client.text_document_rename_async(renamed)
        text = PACK.split("\n")
        for change in sorted(edit.changes[editor.uri], key=lambda change: -change.range.start.character):
            line, start, end = (
                change.range.start.line,
                change.range.start.character,
                change.range.end.character,
            )
            text[line] = text[line][:start] + change.new_text + text[line][end:]
        assert await editor.change("\n".join(text)) == []
        assert "goo swaps below" in "\n".join(text)

        for behind, name, why in (
            ("- go", "empty", "is already a name"),
            ("- go", "count", "cannot be a name"),
            ("- go", "2nd", "cannot be a name"),
            ("below is em", "nil", "comes with powderdsl"),
        ):
            params = lsp.RenameParams(editor.document, editor.at(behind), name)
            with pytest.raises(JsonRpcException, match=why):
                await editor.client.text_document_rename_async(params)

    edited(use, path)


def test_files_are_formatted(folder: Path) -> None:
    async def use(editor: Editor) -> None:
        await editor.open(re.sub(r"^ +", lambda blanks: blanks[0] * 2, PACK, flags=re.MULTILINE))
        options = lsp.FormattingOptions(tab_size=2, insert_spaces=True)
        params = lsp.DocumentFormattingParams(editor.document, options)
        (edit,) = await editor.client.text_document_formatting_async(params)
        assert edit.new_text == PACK

    edited(use, folder / "slime.yaml")


def test_the_outline_has_sections_and_entries(folder: Path) -> None:
    async def use(editor: Editor) -> None:
        await editor.open(PACK)
        symbols = await editor.client.text_document_document_symbol_async(
            lsp.DocumentSymbolParams(editor.document)
        )
        assert [symbol.name for symbol in symbols] == [
            "pack",
            "about",
            "needs",
            "params",
            "elements",
            "passes",
        ]
        assert [symbol.name for symbol in symbols[4].children] == ["slime"]

    edited(use, folder / "slime.yaml")


def broken(text: str, draw: random.Random) -> str:
    """A text after a random edit."""
    at = draw.randrange(len(text))
    return draw.choice(
        [
            text[:at] + text[at + 1 :],
            text[:at] + draw.choice(" :-{}[]#'\"\n\té%0aé𝒳") + text[at:],
            text[:at] + text[at : at + 30] + text[at:],
            text[:at] + text[at + draw.randrange(60) :],
        ]
    )


@pytest.mark.parametrize("count", [25, pytest.param(10_000, marks=pytest.mark.slow)])
def test_random_edits_never_break_it_and_its_mistakes_are_those_of_check(folder: Path, count: int) -> None:
    path, draw = folder / "slime.yaml", random.Random(0)

    async def use(editor: Editor) -> None:
        await editor.open(PACK)
        text = PACK
        for number in range(count):
            text = broken(text, draw) if number % 7 else PACK
            mistakes = await editor.change(text)
            if number % max(1, count // 25) == 0 and KIND.search(text):
                path.write_text(text)
                out = powderdsl("check", "slime.yaml", "--quick", "--notes", "--json").stdout
                assert [mistake.code for mistake in mistakes] == [
                    mistake["code"]
                    for mistake in json.loads(out)
                    if mistake["primary"]["span"] is None
                    or mistake["primary"]["span"]["file"] == "slime.yaml"
                ]
            position = lsp.Position(draw.randrange(20), draw.randrange(40))
            where = {"text_document": editor.document, "position": position}
            await editor.client.text_document_completion_async(lsp.CompletionParams(**where))
            await editor.client.text_document_hover_async(lsp.HoverParams(**where))

    edited(use, path)
