"""What a terminal would obey, or hide, is never printed as it is."""

from __future__ import annotations

import io
import json
import re
import sys
import unicodedata
from pathlib import Path

import click
import pytest

from powderdsl.diagnostics import CompileError, Diagnostic, Label, Reporter, Source, Span
from powderdsl.diagnostics.diagnostic import render_text
from powderdsl.diagnostics.printable import (
    PrintableStream,
    printable,
    printable_streams,
    raw_stream,
    spell,
    write_styled,
)
from tests.cli.commands import powderdsl

HOSTILE = "a\x1b]0;owned\x07\x1b[2J\x9b31m\u202eb\nc"
RAW = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")


def test_every_control_and_format_character_is_escaped():
    kinds = ("Cc", "Cf", "Cs", "Zl", "Zp")
    left = [
        code
        for code in range(sys.maxunicode + 1)
        if unicodedata.category(chr(code)) in kinds and printable(chr(code)) == chr(code)
    ]
    assert left == []


def test_what_people_write_stays():
    text = "±×→ äöü 中文 אב 🙂 é|\u00a0|"
    assert printable(text) == text
    assert printable("a\tb\n", lines=True) == "a\tb\n"
    assert printable("a\tb\n") == "a\\u0009b\\u000a"


def test_json_stays_the_same_json():
    value = {"name": HOSTILE + "\U000e0041"}
    text = printable(json.dumps(value, ensure_ascii=False, indent=1), lines=True)
    assert not RAW.search(text)
    assert json.loads(text) == value


def test_only_colors_pass_as_styles():
    stream = io.StringIO()
    write_styled(stream, "\x1b[31;1mred\x1b[0m")
    assert stream.getvalue() == "\x1b[31;1mred\x1b[0m"
    stream = io.StringIO()
    write_styled(stream, "\x1b[2J\x1b]8;;x\x07\x1b[?25l\x9b31m")
    assert not RAW.search(stream.getvalue())


@pytest.mark.parametrize(
    ("word", "shown"),
    [
        ("wаter", "w\\u0430ter"),
        ("ｗater", "\\uff57ater"),
        ("𝐰ater", "\\ud835\\udc30ater"),
        ("wärme", "wärme"),
        ("вода", "вода"),
        ("wa\u200bter", "wa\\u200bter"),
    ],
)
def test_look_alikes_are_spelled_out(word, shown):
    assert spell(word) == shown


def test_a_stream_escapes_whatever_writes_to_it(capsys):
    with printable_streams():
        print(HOSTILE)
        click.echo(HOSTILE)
        click.echo(HOSTILE, err=True, color=True)
        sys.stdout.writelines([HOSTILE])
    found = capsys.readouterr()
    assert found.out
    assert found.err
    assert not RAW.search(found.out + found.err)


def test_no_way_leads_around_a_stream():
    stream = PrintableStream(io.TextIOWrapper(io.BytesIO(), encoding="ascii"))
    assert not hasattr(stream, "buffer")
    with pytest.raises(TypeError):
        stream.write(b"\x1b")  # type: ignore[arg-type]
    outer = PrintableStream(stream)  # type: ignore[arg-type]
    assert outer.unguarded is stream.unguarded is raw_stream(outer)


def test_diagnostics_escape_every_part():
    span = Span(Source(f"{HOSTILE}.yaml", f"x: {HOSTILE}"), 0, 3)
    one = Diagnostic(
        "PD101", HOSTILE, Label(span, HOSTILE), (Label(span, HOSTILE),), notes=(HOSTILE,), helps=(HOSTILE,)
    )
    assert not RAW.search(render_text(one))
    assert not RAW.search(str(CompileError([one])))
    assert not RAW.search(re.sub(r"\x1b\[[0-9;]*m", "", render_text(one, color=True)))
    # A line break in a message cannot pretend to be a line of its own.
    assert len(render_text(one).splitlines()) == 10


def test_an_empty_place_is_underlined_by_one_caret():
    reporter = Reporter()
    reporter.report("PD101", "a value is missing", Span(Source("pack.yaml", "pack: "), 6, 6))
    with pytest.raises(CompileError) as caught:
        reporter.raise_if_errors()
    (diagnostic,) = caught.value.diagnostics
    assert (diagnostic.primary.span.start, diagnostic.primary.span.end) == (6, 7)
    assert render_text(diagnostic).count("^") == 1


@pytest.mark.parametrize("command", ["check", "show", "test", "show --json", "check --json"])
def test_commands_print_no_codes_from_a_pack(command, tmp_path):
    hostile = '"a\\e]0;owned\\a\\e[2J\\x9b31m\\u202eb\\nc"'
    path = tmp_path / "a\x1b[31m.yaml"
    path.write_text(
        f'pack: odd\nabout: {hostile}\nneeds: core\nelements:\n  foo: {{id: 40, color: "#112233", glyph: f, about: {hostile}}}\n'
        f"params:\n  p: {{type: chance, default: 0.5, about: {hostile}}}\n"
        f"tests:\n  - {hostile}:\n      given: f\n      after: 1 step\n      expect: .\n"
    )
    result = powderdsl(*command.split(), f"core+{path}", exits=1 if command == "test" else 0)
    assert not RAW.search(result.output)


def test_a_name_of_a_file_that_is_not_utf8_is_shown(tmp_path):
    path = Path(str(tmp_path / "x") + "\udcff.yaml")
    assert "\\udcff" in powderdsl("check", str(path), exits=2).output
