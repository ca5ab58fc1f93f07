"""Fetch the trained weights of LPIPS and DISTS: ``python -m experiments.download_weights DIR``.

The same as ``envedit weights DIR``.
"""

import sys

from envedit.cli.weights import main

if __name__ == "__main__":
    sys.exit(main())
