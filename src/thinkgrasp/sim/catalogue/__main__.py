"""Draw all objects: `python -m thinkgrasp.sim.catalogue OUT.png`."""

from __future__ import annotations

import sys
from pathlib import Path

from thinkgrasp.sim.catalogue import make, names
from thinkgrasp.sim.catalogue.sheet import contact_sheet


def main(arguments: list[str]) -> int:
    """Write the contact sheet; return the exit code."""
    if len(arguments) != 1:
        print("usage: python -m thinkgrasp.sim.catalogue OUT.png", file=sys.stderr)
        return 2
    contact_sheet([make(name) for name in names()]).save(Path(arguments[0]), optimize=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
