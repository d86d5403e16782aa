"""Worlds as JSON, as the page reads and writes them (`page/worlds.js`)."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from typing import Any

from powderdsl.model.state import qualified_slots
from powderdsl.model.types import Ruleset


def world_data(
    ruleset: Ruleset, ids: Any, fields: Mapping[str, Any], clock: tuple[int, int, int]
) -> dict[str, Any]:
    """A world as JSON: ids [H, W] and whole fields [H, W] or [2, H, W], by qualified names."""
    qualified = qualified_slots(ruleset)
    return {
        "rows": int(ids.shape[0]),
        "columns": int(ids.shape[1]),
        "palette": {str(element.id): element.qualified for element in ruleset.elements},
        "ids": _text(ids.astype("uint8").tobytes()),
        "fields": {
            qualified.get(name, name): {
                "type": str(values.dtype),
                "components": 2 if values.ndim == 3 else 1,
                "values": _text(values.tobytes()),
            }
            for name, values in fields.items()
        },
        "clock": [str(number) for number in clock],
    }


def first_world_data(world: Any) -> dict[str, Any]:
    """The first of some worlds of a simulator as JSON."""
    state = {name: world.sim.kind.to_numpy(values)[0] for name, values in world.state.items()}
    clock = int(world.seed[0]), int(world.index[0]), int(world.step[0])
    return world_data(world.sim.ruleset, state.pop("element"), state, clock)


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode()
