"""Sections of a small pack with mistakes in drawn fields and kernels, as `test_malformed` has them."""

from __future__ import annotations

# fmt: off
DETAILS: list[tuple[str, str, str, str | None]] = [
    # Fields drawn in tests
    ('an unknown field in a test', 'tests: [{t: {given: w s, expect: w s, fields: {agee: 1}}}]\n', 'PD301', 'agee'),
    ('a drawing of another size', 'tests: [{t: {given: w s, expect: w s, fields: {age: 1 2 3}}}]\n', 'PD110', '1'),
    ('a drawn word that is not a number', 'tests: [{t: {given: w s, expect: w s, fields: {age: x 1}}}]\n', 'PD110', 'x'),
    ('a drawn number out of range', 'tests: [{t: {given: w s, expect: w s, fields: {age: 1 12}}}]\n', 'PD402', '12'),
    ('a start world with a hole', 'tests: [{t: {given: w s, expect: w s, fields: {age: 1 ?}}}]\n', 'PD110', '?'),
    ('a drawn range at the start', 'tests: [{t: {given: w s, expect: w s, fields: {age: 1..2 3}}}]\n', 'PD110', '1..2'),
    ('a drawn vector of one part', 'tests: [{t: {given: w s, expect: w s, fields: {wind: 1 .}}}]\n', 'PD110', '1'),
    ('a drawn element that is unknown', 'tests: [{t: {given: w s, expect: w s, fields: {seed: wed s}}}]\n', 'PD110', 'wed'),
    ('a drawn flag that is a number', 'tests: [{t: {given: w s, expect: w s, fields: {wet: 3 yes}}}]\n', 'PD110', '3'),
    ('a drawn property that nothing assigns', 'tests: [{t: {given: w s, expect: w s, fields: {weight: 1 2}}}]\n', 'PD407', 'weight'),
    ('a drawing that is a list', 'tests: [{t: {given: w s, expect: w s, fields: {age: [1 2]}}}]\n', 'PD107', '[1 2]'),
    ("a kernel of even sides", 'kernels: {k: ["1 1", "1 1"]}\n', "PD110", '"1 1"'),
    ("a ragged kernel", 'kernels: {k: ["1 1 1", "1", "1 1 1"]}\n', "PD110", '"1"'),
    ("a kernel of even rows", 'kernels: {k: ["1 1 1", "1 1 1"]}\n', "PD110", "k"),
    ("a kernel of 33 weights", f'kernels: {{k: ["{"1 " * 33}"]}}\n', "PD110", f'"{"1 " * 33}"'),
    ("a kernel of 33 rows", f"kernels: {{k: [{', '.join(['1'] * 33)}]}}\n", "PD110", "k"),
    ("an empty row of a kernel", 'kernels: {k: ["1", "", "1"]}\n', "PD110", '""'),
    ("a kernel with rows and a shape", 'kernels: {k: {rows: ["1"], shape: box(2)}}\n', "PD109", "shape"),
    ("a kernel with edges alone", "kernels: {k: {edges: wrap}}\n", "PD109", "k"),
    ("a shape without a radius", "kernels: {k: disc}\n", "PD406", "disc"),
    ("a shape of two radii", "kernels: {k: 'disc(2, 3)'}\n", "PD406", "disc(2, 3)"),
    ("a radius of 0", "kernels: {k: box(0)}\n", "PD402", "0"),
    ("a radius of 16", "kernels: {k: box(16)}\n", "PD402", "16"),
    ("a radius with a fraction", "kernels: {k: box(1.5)}\n", "PD405", "1.5"),
    ("a radius in a place of its own", "kernels: {k: box 5}\n", "PD201", "5"),
    ("a kernel that is a set", "kernels: {k: soil}\n", "PD401", "soil"),
    ("a kernel of words", 'kernels: {k: ["a b c"]}\n', "PD110", '"a b c"'),
    ("a kernel of fractions", 'kernels: {k: ["0.5"]}\n', "PD110", '"0.5"'),
    ("an empty kernel", "kernels: {k: []}\n", "PD107", "[]"),
]
