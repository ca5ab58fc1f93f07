"""``envedit cache``: show or delete what is kept on disk between runs."""

from __future__ import annotations

import shutil
import sys

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
    code = 0
    for kind, what in KINDS.items():
        folder, sizes, failed = _visit(kind, arguments.empty)
        if folder is None:
            print("no home folder: nothing is kept")
            break
        entries = f"{len(sizes)} {'entry' if len(sizes) == 1 else 'entries'}, {sum(sizes) / 1e6:.1f} MB"
        print(f"{folder}: {what}: {entries}{' deleted' if arguments.empty else ''}")
        if failed is not None:
            where = failed.filename or folder
            print(f"envedit: {where}: {failed.strerror}; check its permissions", file=sys.stderr)
            code = 3
    if not arguments.empty:
        print("to delete all entries: envedit cache --empty")
    return code


def _visit(kind, empty):
    """Count the entries of a kind, or delete them; returns folder, bytes of each, and the last OSError."""
    from envedit.core.array_cache import DiskCache, cache_folder

    cache = DiskCache(cache_folder(kind))
    sizes = []
    failed = None
    try:
        converted = cache.folder.glob("*/converted.json") if cache.folder else ()
        files = [*cache.files(), *(state.parent for state in converted)]
    except OSError as error:
        return cache.folder, [], error
    for file in files:
        try:
            size = sum(path.stat().st_size for path in (file, *file.rglob("*")))
            if empty and file.is_dir():
                shutil.rmtree(file)
            elif empty:
                file.unlink()
            sizes.append(size)
        except FileNotFoundError:  # another process deleted it first
            pass
        except OSError as error:
            failed = error
    return cache.folder, sizes, failed
