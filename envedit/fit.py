"""``python -m envedit.fit MAP.exr``; see :mod:`envedit.cli.fit`."""

import sys

from envedit.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main(["fit", *sys.argv[1:]]))
