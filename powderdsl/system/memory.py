"""The garbage collector, while graphs are made."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def collection_paused() -> Iterator[None]:
    """Do not look for cycles meanwhile; also a decorator.

    Compilation makes many small objects that all live on. Looking through them, and through everything that torch
    has loaded, again and again takes a quarter of its time and finds nothing.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
