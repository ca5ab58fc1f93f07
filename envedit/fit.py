"""``python -m envedit.fit MAP.exr``; see :mod:`envedit.cli.fit`."""

from envedit.cli.fit import main

if __name__ == "__main__":
    raise SystemExit(main())
