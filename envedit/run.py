"""``python -m envedit.run CONFIG.toml``; see :mod:`envedit.cli.run`."""

from envedit.cli.run import main

if __name__ == "__main__":
    raise SystemExit(main())
