"""The rules of the paper's world and their elements."""

from __future__ import annotations

import powderdsl

RULES = powderdsl.load("powderworld")
ELEMENTS = RULES.elements
ID = {element.name: element.id for element in ELEMENTS}
