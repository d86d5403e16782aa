"""How many universes differ in structure: `python docs/universe_table.py [--texts 30000] [--lowered 1000]`.

Two universes are of one structure if their passes are equal as a set, once names of elements, chances and all numbers are
taken out: "something becomes something else beside something". This is compared twice: in the texts, which is quick, and
in the lowered passes, without constants, sets of elements and names of parameters. Passes on which the two disagree are
counted. Pairs of equal universes in a sample bound how many of the first million differ: for N universes in which p
is the share of equal pairs, at least N / (1 + p (N - 1)) of them differ (Cauchy and Schwarz).
"""

from __future__ import annotations

import argparse
import re
import time
from collections import Counter, defaultdict
from collections.abc import Hashable, Iterable

from powderdsl.compiler import load, lower
from powderdsl.ir.ops import Node, PassGraph, nodes_of
from powderdsl.system.random import mix
from powderdsl.universes import universe_text

MILLION = 1_000_000
DROPPED = ("const", "in_set", "param")
"""Operations whose attribute is a constant, or names something that differs by universe."""
WORD = re.compile(r"\b[a-z]+\b")


def sample(count: int) -> list[int]:
    """Different seeds below a million."""
    seeds: dict[int, None] = {}
    number = 0
    while len(seeds) < count:
        seeds[mix(number) * MILLION >> 32] = None
        number += 1
    return list(seeds)


def of_texts(text: str) -> dict[str, str]:
    """The passes of a text by name, without names of elements, chances and numbers."""
    names = set(re.findall(r"^  (\w+): \{id: ", text, re.MULTILINE)) | {"empty"}
    found = {}
    for part in re.split(r"\n  (?=\w+:\n)", text[text.index("\npasses:") : text.index("\ninvariants:")])[1:]:
        body = "\n".join(part.split("\n")[3:])
        body = re.sub(r"(with chance|interact <) \w+", r"\1 p", body)
        body = WORD.sub(lambda match: "e" if match[0] in names else match[0], body)
        found[part.split(":")[0]] = re.sub(r"(?<=[ .])\d+(?!, -?\d+\))(?=\D|$)", "n", body)
    return found


def of_pass(pass_: PassGraph) -> Hashable:
    """A lowered pass without constants and names."""
    numbers: dict[Node, int] = {}
    rows: list[tuple[object, ...]] = []
    for node in nodes_of(pass_):
        numbers[node] = len(rows)
        attr = None if node.op in DROPPED else node.attr[1] if node.op == "below" else node.attr
        rows.append((node.op, node.type.name, *(numbers[arg] for arg in node.args), repr(attr)))
    writes = [(slot, numbers[node]) for step in pass_.substeps for slot, node in step.writes]
    return tuple(rows), tuple(writes), tuple((slot, numbers[node]) for slot, node in pass_.outputs)


def bound(structures: Iterable[Hashable]) -> str:
    """What a sample says: how many differ, equal pairs, and how many of the first million differ at least."""
    counts = Counter(structures)
    size = sum(counts.values())
    pairs = sum(count * (count - 1) // 2 for count in counts.values())
    most = pairs + 3 + 2 * pairs**0.5  # above the expected number, with 95% confidence
    share = most / (size * (size - 1) / 2)
    least = MILLION / (1 + share * (MILLION - 1))
    return f"{size:,} universes, {len(counts):,} structures, {pairs} equal pairs: at least {least:,.0f} of the first million"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--texts", type=int, default=30_000)
    parser.add_argument("--lowered", type=int, default=1_000)
    options = parser.parse_args()
    began = time.process_time()
    texts = [tuple(sorted(of_texts(universe_text(seed)).values())) for seed in sample(options.texts)]
    print(f"texts:   {bound(map(hash, texts))} ({time.process_time() - began:.0f} s)", flush=True)
    began = time.process_time()
    lowered: list[Hashable] = []
    forms: dict[str, set[Hashable]] = defaultdict(set)
    spelled: dict[Hashable, set[str]] = defaultdict(set)
    for seed in sample(options.lowered):
        written = of_texts(universe_text(seed))
        passes = {
            pass_.name: of_pass(pass_)
            for pass_ in lower(load(f"universe:{seed}")).passes
            if pass_.name in written
        }
        lowered.append(tuple(sorted(map(hash, passes.values()))))
        for name, form in passes.items():
            forms[written[name]].add(form)
            spelled[form].add(written[name])
    print(f"lowered: {bound(lowered)} ({time.process_time() - began:.0f} s)")
    apart = sum(len(found) > 1 for found in forms.values())
    together = sum(len(found) > 1 for found in spelled.values())
    print(
        f"passes:  {len(forms)} in texts, {len(spelled)} lowered; {apart} of a text that lower differently, {together} that "
        "lower alike from different texts"
    )


if __name__ == "__main__":
    main()
