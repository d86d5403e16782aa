"""`python -m powderdsl`."""

from __future__ import annotations

from powderdsl.cli import main

if __name__ == "__main__":
    main()
