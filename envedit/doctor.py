"""``python -m envedit.doctor``; see :mod:`envedit.cli.doctor`."""

from envedit.cli.doctor import main

if __name__ == "__main__":
    raise SystemExit(main())
