"""``envedit cache``: what is kept between runs, where, how large; and emptying it."""

from __future__ import annotations

import argparse
import sys

KINDS = {"transport": "light transports of scenes", "fits": "networks fitted to maps"}


def main(argv: list[str] | None = None) -> int:
    """Say what the cache holds, or empty it; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="envedit cache",
        description="Show what envedit keeps between runs. Everything in it can be made again.",
        epilog="example: envedit cache --empty",
    )
    parser.add_argument("--empty", action="store_true", help="delete all entries")
    arguments = parser.parse_args(argv)
    from envedit.core.array_cache import DiskCache, cache_folder

    code = 0
    for kind, what in KINDS.items():
        cache = DiskCache(cache_folder(kind))
        files, size = cache.files(), 0
        for file in files:
            try:
                size += file.stat().st_size
                if arguments.empty:
                    file.unlink()
            except FileNotFoundError:  # another process was quicker
                continue
            except OSError as error:
                print(f"envedit: {file}: cannot be deleted ({error.strerror})", file=sys.stderr)
                code = 3
        entries = f"{len(files)} {'entry' if len(files) == 1 else 'entries'}, {size / 1e6:.1f} MB"
        print(f"{cache.folder}: {what}: {entries}{', deleted' if arguments.empty and files else ''}")
    return code
