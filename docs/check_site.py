"""Looks for dead links and missing pictures in the built documentation: `python docs/check_site.py site`.

Only what lies in the folder is checked; nothing is fetched. Exits with 1 if a link leads nowhere.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit


class PageLinks(HTMLParser):
    """The links of a page, and the ids that others may link to."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.targets: list[str] = []
        self.ids = {"", "__skip"}
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.ids.update(value for key in ("id", "name") if (value := values.get(key)))
        self.targets += [value for key in ("href", "src") if (value := values.get(key))]


def dead_links(site: Path) -> Iterator[str]:
    """Lines such as `a/index.html: b.html#c`, for each link that leads nowhere."""
    # The playground builds its page with JavaScript and has tests of its own; 404.html has absolute links only.
    pages = [
        page
        for page in sorted(site.rglob("*.html"))
        if page.relative_to(site).parts[0] not in ("play", "404.html")
    ]
    links = {page.resolve(): PageLinks(page) for page in pages}
    for page, its in links.items():
        for target in its.targets:
            parts = urlsplit(target)
            if parts.scheme or parts.netloc:
                continue
            other = (page.parent / unquote(parts.path)).resolve() if parts.path else page
            if other.is_dir():
                other = other / "index.html"
            if not other.exists() or (other in links and unquote(parts.fragment) not in links[other].ids):
                yield f"{page.relative_to(site.resolve())}: {target}"


def main() -> int:
    site = Path(sys.argv[1])
    lines = list(dead_links(site))
    print(*lines, sep="\n", end="\n" if lines else "", file=sys.stderr)
    print(f"{site}: {len(list(site.rglob('*.html')))} pages, {len(lines)} dead links")
    return bool(lines)


if __name__ == "__main__":
    sys.exit(main())
