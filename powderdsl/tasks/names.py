"""Which names mean tasks."""

from __future__ import annotations

from powderdsl.compiler import shipped
from powderdsl.system.reading import open_regular

MAX_HEAD = 1 << 16
"""Bytes of comments that a task's file may begin with."""


def shipped_tasks() -> list[str]:
    """Names of the tasks that come with powderdsl."""
    return sorted(path.stem for path in shipped("tasks").glob("*.yaml"))


def is_task(name: str) -> bool:
    """Whether a name or path means a task: a shipped one, or a file that begins with ``task:``."""
    if name in shipped_tasks():
        return True
    if not name.lower().endswith((".yaml", ".yml")):
        return False
    try:
        with open_regular(name) as file:
            head = file.read(MAX_HEAD).decode("utf-8-sig", errors="replace")
    except OSError:
        return False
    lines = (line.strip() for line in head.splitlines())
    return next((line for line in lines if line and not line.startswith("#")), "").startswith("task:")
