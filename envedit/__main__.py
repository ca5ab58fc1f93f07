"""``python -m envedit``; see :mod:`envedit.cli.main`."""

from envedit.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main())
