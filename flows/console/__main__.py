"""`python -m flows.console` is `pasdedeux`."""

from __future__ import annotations

from flows.console import main

if __name__ == "__main__":
    main()
