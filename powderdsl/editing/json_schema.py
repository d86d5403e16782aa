"""The JSON Schema of all files: keys, their meanings and their values."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

from powderdsl.editing.records import SCALAR, JsonSchema, entries, one_or_list
from powderdsl.model.declarations import KernelDecl, PackDecl, RulesetDecl, StreamDecl, TestDecl

TITLE = "Files of powderdsl: packs, rulesets, tasks, scenes and studies"

MADE = Path(__file__).parents[1] / "data" / "schema.json"
"""The schema in the archive for Pyodide, which lacks the modules of tasks and studies."""


@cache
def schema() -> dict[str, Any]:
    """The JSON Schema of all kinds of files. The first key of a file determines its kind."""
    if MADE.is_file():
        return dict(json.loads(MADE.read_text(encoding="utf-8")))
    from powderdsl.experiments.studies.study import AxisDecl, Measure, StudyDecl
    from powderdsl.tasks.agents import ExpertDecl, MoveDecl
    from powderdsl.tasks.file import StandDecl, TaskDecl
    from powderdsl.worlds.scene.read import FileDecl, SceneDecl

    records = JsonSchema()
    listed = {"type": "array", "items": SCALAR}
    pair = {**listed, "minItems": 2, "maxItems": 2}
    scalars, named = (
        {"type": "object", "additionalProperties": SCALAR},
        {"minProperties": 1, "maxProperties": 1},
    )
    in_loop = {
        "anyOf": [SCALAR, {"type": "object", "properties": {"let": scalars}, "additionalProperties": False}]
    }
    loop = {"type": "object", "patternProperties": {"^repeat ": {"type": "array", "items": in_loop}}, **named}
    loop["additionalProperties"] = False
    statements = {"type": ["array", "null"], "items": {"anyOf": [SCALAR, loop]}}
    words = one_or_list(SCALAR)
    test = {"type": "object", "additionalProperties": records.of(TestDecl), **named}
    step = {"type": "object", "additionalProperties": words, "required": ["command"]}
    records.values = {
        ("pack", "tests"): {"type": "array", "items": test},
        ("test", "often"): one_or_list(scalars),
        ("pack", "streams"): {"anyOf": [listed, entries(records.of(StreamDecl))]},
        ("pack", "kernels"): entries({"anyOf": [listed, records.of(KernelDecl)]}),
        ("agent", "brush"): {"anyOf": [SCALAR, pair]},
        ("agent", "bins"): {"anyOf": [SCALAR, pair]},
        ("move", "at"): {"anyOf": [{"type": "string"}, pair]},
        ("task", "size"): pair,
        ("task", "regions"): entries(words),
        ("task", "expert"): {
            "anyOf": [{"type": "array", "items": records.of(MoveDecl)}, records.of(ExpertDecl)]
        },
        ("file", "scenes"): {"type": "array", "items": records.of(SceneDecl)},
        ("scene", "size"): pair,
        ("scene", "draw"): listed,
        ("axis", "sets"): {"type": "object", "additionalProperties": scalars},
        ("study", "vary"): entries({"anyOf": [listed, records.of(AxisDecl)]}),
        ("study", "steps"): entries(step),
        ("study", "measures"): entries(records.of(Measure)),
        ("split", "stands"): {"type": "array", "items": records.of(StandDecl)},
    }
    for variant in ("task", "split", "stand"):
        own = {
            "generate": statements,
            "let": scalars,
            "parts": entries(statements),
            "targets": entries(statements),
        }
        if variant != "task":
            own["knobs"] = scalars
        records.values |= {(variant, key): value for key, value in own.items()}
    kinds = {
        "task": TaskDecl,
        "study": StudyDecl,
        "scene": SceneDecl,
        "scenes": FileDecl,
        "ruleset": RulesetDecl,
    }
    choice: dict[str, Any] = records.of(PackDecl)
    for key, kind in reversed(kinds.items()):
        choice = {"if": {"required": [key]}, "then": records.of(kind), "else": choice}
    top = {"$schema": "http://json-schema.org/draft-07/schema#", "title": TITLE, "type": "object"}
    return {**top, **choice, "definitions": records.definitions()}
