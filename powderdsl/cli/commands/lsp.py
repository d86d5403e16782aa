"""`powderdsl lsp`: a language server over stdin and stdout."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from powderdsl.cli import options as opt
from powderdsl.system.packages import require

if TYPE_CHECKING:
    from powderdsl.diagnostics import Diagnostic, Source, Span
    from powderdsl.syntax.yaml_tree import Node


@click.command("lsp")
@opt.option("--with", str, "Rules to check packs with, besides those that they need.", "", to="beside")
def command(beside: str) -> None:
    """Run a language server for editors, over stdin and stdout.

    It reports mistakes while you type, completes and explains words, finds definitions and uses, and renames, fixes,
    formats and outlines packs, rulesets, tasks, scenes and studies. Editors start this command: see docs/editors.md.
    """
    require("pygls", "lsp")
    assert sys.__stdin__ is not None
    assert sys.__stdout__ is not None
    server(beside).start_io(sys.__stdin__.buffer, sys.__stdout__.buffer)


def server(beside: str = "") -> Any:
    """A language server with its own workspace."""
    from lsprotocol import types as lsp
    from pygls.lsp.server import LanguageServer
    from pygls.uris import from_fs_path, to_fs_path

    from powderdsl.cli.commands.study import commands
    from powderdsl.cli.exits import version
    from powderdsl.diagnostics import Reporter, Severity, Source
    from powderdsl.editing.layout import formatted
    from powderdsl.editing.workspace import Workspace
    from powderdsl.syntax.yaml_tree import Mapping, Scalar
    from powderdsl.system import cache

    cache.STORED = False  # each key would store a model
    served = LanguageServer("powderdsl", version())
    files = Workspace(beside, commands)
    ended: list[bool] = []
    mistakes: dict[Path, tuple[Diagnostic, ...]] = {}
    shown: dict[Path, tuple[str, ...]] = {}
    levels = {
        Severity.ERROR: lsp.DiagnosticSeverity.Error,
        Severity.WARNING: lsp.DiagnosticSeverity.Warning,
        Severity.NOTE: lsp.DiagnosticSeverity.Information,
    }
    kinds = {
        "key": lsp.CompletionItemKind.Property,
        "element": lsp.CompletionItemKind.Class,
        "tag": lsp.CompletionItemKind.Interface,
        "function": lsp.CompletionItemKind.Function,
        "field": lsp.CompletionItemKind.Field,
        "property": lsp.CompletionItemKind.Field,
        "parameter": lsp.CompletionItemKind.Variable,
        "pack": lsp.CompletionItemKind.Module,
        "value": lsp.CompletionItemKind.EnumMember,
    }

    def path_of(document: Any) -> Path:
        return Path(to_fs_path(document.uri) or document.uri)

    def uri_of(span: Span) -> str:
        return str(from_fs_path(str(Path(span.source.name).resolve())))

    def place(source: Source, offset: int) -> lsp.Position:
        line, column = source.position(offset)
        before = source.line(line)[: column - 1]
        return lsp.Position(line - 1, len(before.encode("utf-16-le", "surrogatepass")) // 2)

    def between(span: Span) -> lsp.Range:
        return lsp.Range(place(span.source, span.start), place(span.source, span.end))

    def offset(path: Path, position: lsp.Position) -> int:
        lines = files.text(path).split("\n")
        number = min(position.line, len(lines) - 1)
        units = lines[number].encode("utf-16-le", "surrogatepass")[: 2 * position.character]
        return sum(len(line) + 1 for line in lines[:number]) + len(units.decode("utf-16-le", "ignore"))

    def as_lsp(diagnostic: Diagnostic) -> lsp.Diagnostic:
        span = diagnostic.primary.span
        lines = [diagnostic.message, diagnostic.primary.text, *diagnostic.notes]
        lines += [f"help: {text}" for text in diagnostic.helps]
        related = [
            lsp.DiagnosticRelatedInformation(
                lsp.Location(uri_of(label.span), between(label.span)), label.text
            )
            for label in diagnostic.secondary
            if label.span is not None
        ]
        start = lsp.Position(0, 0)
        return lsp.Diagnostic(
            range=lsp.Range(start, start) if span is None else between(span),
            message="\n".join(filter(None, lines)),
            severity=levels[diagnostic.severity],
            code=diagnostic.code,
            source="powderdsl",
            related_information=related or None,
        )

    def check(path: Path) -> None:
        """Publish the mistakes found from a file, in every file that contains some."""
        own = str(from_fs_path(str(path)))
        by_file: dict[str, list[lsp.Diagnostic]] = {own: []}
        mistakes[path] = files.check(path)
        if not shown:
            gc.freeze()  # modules and shipped packs: searching them again and again takes as long as a check
        for diagnostic in mistakes[path]:
            span = diagnostic.primary.span
            by_file.setdefault(own if span is None else uri_of(span), []).append(as_lsp(diagnostic))
        for uri in dict.fromkeys([*shown.get(path, ()), *by_file]):
            served.text_document_publish_diagnostics(lsp.PublishDiagnosticsParams(uri, by_file.get(uri, [])))
        shown[path] = tuple(by_file)

    @served.feature(lsp.TEXT_DOCUMENT_DID_OPEN)
    @served.feature(lsp.TEXT_DOCUMENT_DID_CHANGE)
    def changed(params: Any) -> None:
        path = path_of(params.text_document)
        files.open(path, served.workspace.get_text_document(params.text_document.uri).source)
        check(path)
        waiting = getattr(served.protocol, "_request_futures", {})  # pygls never removes notifications
        for key in [key for key, future in waiting.items() if future.done()]:
            del waiting[key]

    @served.feature(lsp.TEXT_DOCUMENT_DID_CLOSE)
    def closed(params: lsp.DidCloseTextDocumentParams) -> None:
        path = path_of(params.text_document)
        files.close(path)
        mistakes.pop(path, None)
        for uri in shown.pop(path, ()):
            served.text_document_publish_diagnostics(lsp.PublishDiagnosticsParams(uri, []))

    @served.feature(lsp.TEXT_DOCUMENT_COMPLETION, lsp.CompletionOptions())
    def complete(params: lsp.CompletionParams) -> list[lsp.CompletionItem]:
        path = path_of(params.text_document)
        words = files.complete(path, offset(path, params.position))
        return [
            lsp.CompletionItem(
                word.name,
                kind=kinds.get(word.kind, lsp.CompletionItemKind.Keyword),
                detail=word.kind,
                documentation=word.about or None,
            )
            for word in words
        ]

    @served.feature(lsp.TEXT_DOCUMENT_HOVER)
    def hover(params: lsp.HoverParams) -> lsp.Hover | None:
        path = path_of(params.text_document)
        shown_text = files.hover(path, offset(path, params.position))
        if shown_text is None:
            return None
        text, span = shown_text
        return lsp.Hover(lsp.MarkupContent(lsp.MarkupKind.Markdown, text), between(span))

    def locations(spans: Sequence[Span]) -> list[lsp.Location]:
        return [lsp.Location(uri_of(span), between(span)) for span in spans]

    @served.feature(lsp.TEXT_DOCUMENT_DEFINITION)
    def definition(params: lsp.DefinitionParams) -> list[lsp.Location]:
        path = path_of(params.text_document)
        return locations(files.definition(path, offset(path, params.position)))

    @served.feature(lsp.TEXT_DOCUMENT_REFERENCES)
    def references(params: lsp.ReferenceParams) -> list[lsp.Location]:
        path = path_of(params.text_document)
        return locations(files.references(path, offset(path, params.position)))

    @served.feature(lsp.TEXT_DOCUMENT_RENAME)
    def rename(params: lsp.RenameParams) -> lsp.WorkspaceEdit:
        path = path_of(params.text_document)
        try:
            spans = files.rename(path, offset(path, params.position), params.new_name)
        except ValueError as error:
            from pygls.exceptions import JsonRpcInvalidParams

            raise JsonRpcInvalidParams(str(error)) from None
        changes: dict[str, list[lsp.TextEdit]] = {}
        for span in spans:
            changes.setdefault(uri_of(span), []).append(lsp.TextEdit(between(span), params.new_name))
        return lsp.WorkspaceEdit(changes=changes)

    @served.feature(
        lsp.TEXT_DOCUMENT_CODE_ACTION, lsp.CodeActionOptions(code_action_kinds=[lsp.CodeActionKind.QuickFix])
    )
    def fixes(params: lsp.CodeActionParams) -> list[lsp.CodeAction]:
        path = path_of(params.text_document)
        here = params.range
        actions = []
        for diagnostic in mistakes.get(path, ()):
            if diagnostic.fix is None:
                continue
            span, text = diagnostic.fix
            where = between(span)
            if (
                where.start <= here.end
                and here.start <= where.end
                and uri_of(span) == params.text_document.uri
            ):
                edit = lsp.WorkspaceEdit(changes={uri_of(span): [lsp.TextEdit(where, text)]})
                title, kind = f"Write `{text}`", lsp.CodeActionKind.QuickFix
                actions.append(lsp.CodeAction(title, kind, [as_lsp(diagnostic)], edit=edit))
        return actions

    def symbols(node: Node | None, depth: int) -> list[lsp.DocumentSymbol]:
        if depth == 0 or node is None or isinstance(node, Scalar):
            return []
        items = [item for item in node.items if isinstance(item, Mapping)]
        entries = (
            node.entries if isinstance(node, Mapping) else [e for item in items for e in item.entries[:1]]
        )
        rows = []
        for key, value in entries:
            below = symbols(value, depth - 1)
            sort = lsp.SymbolKind.Namespace if below else lsp.SymbolKind.Field
            whole = between(key.span.to(value.span))
            rows.append(lsp.DocumentSymbol(key.text[:80], sort, whole, between(key.span), children=below))
        return rows

    @served.feature(lsp.TEXT_DOCUMENT_DOCUMENT_SYMBOL)
    def outline(params: lsp.DocumentSymbolParams) -> list[lsp.DocumentSymbol]:
        return symbols(files.outline(path_of(params.text_document)), 2)

    @served.feature(lsp.TEXT_DOCUMENT_FORMATTING)
    def layout(params: lsp.DocumentFormattingParams) -> list[lsp.TextEdit]:
        path = path_of(params.text_document)
        source = Source(str(path), files.text(path))
        text = formatted(source, Reporter())
        if text is None or text == source.text:
            return []
        end = place(source, len(source.text))
        return [lsp.TextEdit(lsp.Range(lsp.Position(0, 0), end), text)]

    @served.feature(lsp.SHUTDOWN)
    def shut_down(*_: Any) -> None:
        ended.append(True)

    @served.feature(lsp.EXIT)
    def leave(*_: Any) -> None:
        os._exit(0 if ended else 1)  # the thread that reads stdin would wait for more

    return served
