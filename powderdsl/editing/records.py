"""The records of files as JSON Schema (draft 7), for editors that complete and check YAML."""

from __future__ import annotations

from typing import Any

from powderdsl.model.schema import MAX_NAME, Entry, Key, Record, keys_of

Schema = dict[str, Any]

SCALAR: Schema = {"type": ["string", "number", "boolean"]}
"""A single value. Files read it as text, regardless of its YAML type."""

NAMES: Schema = {"pattern": f"^[A-Za-z_][A-Za-z0-9_]{{0,{MAX_NAME - 1}}}$"}
"""Keys that define names."""


def one_or_list(item: Schema) -> Schema:
    """A value, or a list of such values."""
    return {"anyOf": [item, {"type": "array", "items": item}]}


def _word(row: Key) -> Schema:
    if row.choices:
        return {"enum": [*row.choices, *(int(choice) for choice in row.choices if choice.isdigit())]}
    return {**SCALAR, "pattern": f"^(?:{row.form.pattern})$"} if row.form else SCALAR


def entries(item: Schema, *, names: bool = True) -> Schema:
    """A mapping from keys, which define names unless `names` is false, to items; or nothing."""
    return {
        "type": ["object", "null"],
        "additionalProperties": item,
        **({"propertyNames": NAMES} if names else {}),
    }


class JsonSchema:
    """Creates references to records, and their definitions.

    `values` has the schemas of values that declarations leave open, by record and key.
    """

    def __init__(self) -> None:
        self.values: dict[tuple[str, str], Schema] = {}
        self._kinds: dict[str, type[Record]] = {}

    def of(self, kind: type[Record]) -> Schema:
        """A reference to a record's definition."""
        name = kind.__name__.removesuffix("Decl").lower()
        self._kinds[name] = kind
        return {"$ref": f"#/definitions/{name}"}

    def definitions(self) -> dict[str, Schema]:
        """The definitions of all records that were referred to, here or in another definition."""
        made: dict[str, Schema] = {}
        while missing := [name for name in self._kinds if name not in made]:
            made |= {name: self._definition(name, self._kinds[name]) for name in missing}
        return made

    def _definition(self, name: str, kind: type[Record]) -> Schema:
        keys = keys_of(kind)
        required = [row.name for row in keys.values() if row.required]
        mapping: Schema = {
            "type": "object",
            "properties": {
                row.name: {"description": row.about, **self._value(name, row)} for row in keys.values()
            },
            "additionalProperties": SCALAR if kind.OTHERS or not keys else False,
            **({"required": required} if required else {}),
        }
        if kind.PREFIXES:
            lines = {f"^({'|'.join(kind.PREFIXES)})": self._block()}
            mapping["patternProperties"] = lines
        if issubclass(kind, Entry) and any(row.short for row in keys.values()):
            short = next(row for row in keys.values() if row.short)
            return {"anyOf": [self._value(name, short), mapping]}
        return mapping

    def _value(self, name: str, row: Key) -> Schema:
        if (name, row.name) in self.values:
            return self.values[name, row.name]
        match row.shape:
            case "text" | "word" | "line":
                return _word(row)
            case "flag":
                return {"enum": [True, False, "yes", "no"]}
            case "number":
                if row.choices:
                    return _word(row)
                low, high = row.bounds
                return {"type": "integer", "minimum": low, "maximum": high}
            case "words" | "lines" | "invariants":
                return one_or_list(SCALAR)
            case "record":
                return self.of(row.type)
            case "section":
                return entries(self.of(row.type), names=bool(row.type.NOUN))
            case "pairs":
                return {"type": "object", "additionalProperties": SCALAR}
        assert row.shape == "block", f"`values` lacks {name}.{row.name}"
        return self._block()

    def _block(self) -> Schema:
        """A rule, or a list of rules and blocks."""
        from powderdsl.model.declarations import Block

        block = self.of(Block)
        return {"anyOf": [SCALAR, block, {"type": "array", "items": {"anyOf": [SCALAR, block]}}]}
