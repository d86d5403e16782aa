"""The table of keys of task files. Shape checks and the documentation use it."""

from __future__ import annotations

from powderdsl.model.schema import Key

_VARIANT = {
    "knobs": Key("mapping", "other values for knobs"),
    "let": Key("mapping", "other values or ranges for names of `let`"),
    "parts": Key("mapping", "other statements for parts"),
    "generate": Key("any", "other statements altogether"),
}

TASK_KEYS: dict[str, dict[str, Key]] = {
    "task": {
        "task": Key("word", "the task's name", True),
        "about": Key("text", "what is to be done, in a sentence"),
        "family": Key("word", "what tasks of its kind have in common, such as `build` or `herd`"),
        "rules": Key(
            "word", "the rules of its worlds: a shipped ruleset, packs joined by `+`, or a file", True
        ),
        "params": Key("mapping", "other values for the rules' parameters"),
        "size": Key("any", "[rows, columns]", True),
        "fill": Key("word", "the element that is everywhere before anything is drawn", True),
        "knobs": Key("mapping", "integers that are set from outside"),
        "let": Key("mapping", "numbers and draws that statements and regions share, in order"),
        "regions": Key("mapping", "names for sets of cells: a shape each, or a list of shapes"),
        "stamps": Key("mapping", "pictures that statements paint"),
        "parts": Key("mapping", "lists of statements with a name"),
        "targets": Key("mapping", "pictures that rewards compare worlds with: lists of statements"),
        "generate": Key("any", "statements, later ones over earlier ones"),
        "agent": Key("mapping", "what an agent may do, and for how long", True),
        "reward": Key("mapping", "what counts: `each`, `final`, or both; and `shaped`, for training"),
        "end": Key("mapping", "conditions that end an episode: `success`, `failure`"),
        "expert": Key("any", "how a good player acts: a list of moves, or `search: N`"),
        "splits": Key("mapping", "other sets of worlds beside `train`"),
    },
    "knob": {
        "default": Key("line", "its value unless another is set; it may depend on knobs above it", True),
        "range": Key("line", "the values it may have: `LOW..HIGH`", True),
        "about": Key("text", "what it does, in a sentence"),
    },
    "stamp": {
        "art": Key("text", "ASCII art; `?` leaves a cell as it is"),
        "legend": Key("mapping", "what the characters mean, where glyphs will not do"),
        "scene": Key("word", "instead of art: a shipped scene, or a world's file beside the task's"),
    },
    "agent": {
        "may": Key("words", "elements it may place, `any`, `blow`, `nothing`", True),
        "speed": Key("number", "the speed that blowing gives to cells"),
        "speed_field": Key("word", "the field that blowing sets; the ruleset's only vector, if it has one"),
        "brush": Key("any", "cells that an action changes: a number, or [rows, columns]; 10 by default"),
        "bins": Key("any", "places that it can act at: a number, or [rows, columns]; 16 by default"),
        "actions": Key("number", "how many actions an episode has", True),
        "steps_per_action": Key("number", "steps after each action; 1 by default"),
        "free_steps": Key("number", "steps after the last action, besides; 0 by default"),
    },
    "reward": {
        "each": Key("line", "given after every action"),
        "final": Key("line", "given with the last action, after the free steps"),
        "shaped": Key("line", "given after every action in place of both, where training asks for it"),
    },
    "end": {
        "success": Key("line", "the episode ends, and the task is done"),
        "failure": Key("line", "the episode ends, and the task is not done"),
    },
    "expert": {
        "search": Key(
            "number", "random plans that are simulated in each world; the best one is played", True
        ),
    },
    "move": {
        "choose": Key("word", "what it does: an element, `blow` or `nothing`", True),
        "toward": Key("word", "where it blows: `left`, `right`, `above`, `below`, or both as `above.right`"),
        "at": Key("any", "where: `[row, column]`, or `most(CELLS)`, the block with most of these cells"),
        "within": Key("line", "a shape: only its cells count for `most`"),
        "least": Key("number", "how many cells `most` must find for the move to apply; 1 by default"),
        "if": Key("line", "when: a condition; the first move whose condition holds is played"),
    },
    "split": {
        "about": Key("text", "what it is for, in a sentence"),
        **_VARIANT,
        "stands": Key("list", "fixed worlds: a list of such changes, each with a name under `stand`"),
    },
    "stand": {
        "stand": Key("word", "its name", True),
        "about": Key("text", "what it shows, in a sentence"),
        **_VARIANT,
    },
}
