"""README.md for PyPI, where links and pictures need whole addresses: a metadata hook of Hatchling."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

FILES = "https://github.com/powderdsl/powderdsl/blob/main/"
PICTURES = "https://raw.githubusercontent.com/powderdsl/powderdsl/main/"


class ReadmeForPypi(MetadataHookInterface):
    """Sets the long description."""

    def update(self, metadata: dict[str, Any]) -> None:
        text = Path(self.root, "README.md").read_text(encoding="utf-8")
        text = re.sub(r"(!\[[^\]]*\]\()(?!https?:)", rf"\1{PICTURES}", text)
        text = re.sub(r"(?<!!)(\[[^\]]*\]\()(?!https?:|#)", rf"\1{FILES}", text)
        metadata["readme"] = {"content-type": "text/markdown", "text": text}
