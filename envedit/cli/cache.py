"""``envedit cache``: show or delete what is kept on disk between runs."""

from __future__ import annotations

import contextlib
import shutil

from envedit.cli import console

KINDS = {
    "transport": "light transports of scenes",
    "fits": "SIRENs fitted to maps",
    "renderings": "renderings of initial and target maps",
    "usd": "scenes that were USD files",
    "scene_files": "which files of scenes can be read",
}


def main(argv: list[str] | None = None) -> int:
    """Say what the cache holds, or empty it; returns the exit code."""
    parser = console.make_parser(
        "cache",
        "Show what envedit keeps on disk between runs, or delete it. A later run computes again\n"
        "what it needs. The cache lies in ~/.cache/envedit, or in $XDG_CACHE_HOME/envedit.",
        ["envedit cache", "envedit cache --empty"],
    )
    parser.add_argument("--empty", action="store_true", help="delete all entries, and nothing else")
    arguments = parser.parse_args(argv)
    return console.exit_code(console.Console(), lambda: _visit(arguments.empty))


def _visit(empty):
    """Say how many entries of each kind there are, or delete them."""
    from envedit.core.array_cache import DiskCache, cache_folder
    from envedit.core.errors import InputError

    for kind, what in KINDS.items():
        cache = DiskCache(cache_folder(kind))
        if cache.folder is None:
            print("no home folder: nothing is kept")
            break
        sizes = []
        try:
            for file in (*cache.files(), *(state.parent for state in cache.folder.glob("*/converted.json"))):
                with contextlib.suppress(FileNotFoundError):  # another process deleted it first
                    sizes.append(_size(file))
                    if empty:
                        shutil.rmtree(file) if file.is_dir() else file.unlink()
        except OSError as error:
            where = error.filename or cache.folder
            raise InputError(f"{where}: {error.strerror}; check its permissions") from None
        entries = f"{len(sizes)} {'entry' if len(sizes) == 1 else 'entries'}, {sum(sizes) / 1e6:.1f} MB"
        print(f"{cache.folder}: {what}: {entries}{' deleted' if empty else ''}")
    if not empty:
        print("to delete all entries: envedit cache --empty")
    return 0


def _size(file):
    return sum(path.stat().st_size for path in (file, *file.rglob("*")))
