"""Which names mean tasks."""

from __future__ import annotations

from pathlib import Path

from powderdsl.compiler import shipped


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
        with Path(name).open(encoding="utf-8-sig") as file:
            lines = (line.strip() for line, _ in zip(file, range(1000), strict=False))
            return next((line for line in lines if line and not line.startswith("#")), "").startswith("task:")
    except (OSError, ValueError):
        return False
