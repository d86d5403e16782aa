"""Kernels as rows of weights."""

from __future__ import annotations

import re

from powderdsl.model.builtins import MAX_RADIUS
from powderdsl.model.schema import Reader
from powderdsl.syntax.yaml_tree import Node, Scalar


def kernel_rows(reader: Reader, key: Scalar, node: Node) -> tuple[tuple[int, ...], ...] | None:
    """Rows of weights with a cell in the middle; reports what they lack."""
    most = 2 * MAX_RADIUS + 1
    rows = []
    for word in reader.words(node):
        parts = word.text.split()
        if not parts or not all(re.fullmatch(r"-?[0-9]{1,3}", part) for part in parts):
            reader.reporter.error(
                "PD110",
                "a kernel row that is not integers",
                word.span,
                "not a row of weights",
                helps=['write "1 0 1", numbers up to 999 with blanks between them'],
            )
            return None
        rows.append((tuple(int(part) for part in parts), word.span))
    if not rows:
        reader.shape(node, "rows of weights", 'write ["1 1 1", "1 0 1", "1 1 1"]')
        return None
    width = len(rows[0][0])
    for row, span in rows:
        if len(row) > most:
            label = f"{len(row)} weights: a kernel reaches {MAX_RADIUS} cells to each side"
            reader.reporter.error(
                "PD110", "a kernel that is too wide", span, label, helps=[f"write at most {most}"]
            )
            return None
        if len(row) % 2 == 0:
            helps = ["write an odd number of weights, the cell's own in the middle"]
            reader.reporter.error(
                "PD110", f"kernel `{key.text}` has no middle", span, f"{len(row)} weights are an even number", helps=helps
            )  # fmt: skip
            return None
        if len(row) != width:
            label = f"{len(row)} weights, the first row has {width}"
            reader.reporter.error("PD110", "the rows of a kernel are equally long", span, label)
            return None
    if len(rows) > most or len(rows) % 2 == 0:
        fault = "has no middle" if len(rows) <= most else "is too high"
        label = f"{len(rows)} rows" + (" are an even number" if len(rows) % 2 == 0 else "")
        helps = [f"write an odd number of rows, at most {most}, the cell's own in the middle"]
        reader.reporter.error("PD110", f"kernel `{key.text}` {fault}", key.span, label, helps=helps)
        return None
    return tuple(row for row, _ in rows)
