"""``python -m envedit.doctor``; see :mod:`envedit.cli.doctor`."""

import sys

from envedit.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main(["doctor", *sys.argv[1:]]))
