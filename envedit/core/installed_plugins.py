"""Mitsuba's plugins, taken from its installation only.

Mitsuba loads ``plugins/NAME.so`` from the first folder of its file resolver that has it, and from the working
folder if none has. The resolver begins with the working folder, and ``<path value="."/>`` in a scene puts the
scene's folder before it: a shared object beside a scene would run, under a new name or in place of a plugin.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator
from pathlib import Path

import mitsuba as mi

from envedit.core.errors import InputError

_NAME = re.compile(r"[A-Za-z0-9_-]+")  # a dot or a slash would name another file
_SUFFIXES = (".so", ".dylib", ".dll")


def installation() -> Path:
    """Return the folder of the installed Mitsuba, which holds ``plugins``."""
    return Path(mi.__file__).parent


def come_first() -> None:
    """Have Mitsuba look for plugins in its installation before any other folder of its file resolver.

    To be called before Mitsuba builds anything, as every scene that somebody parses may change the order.
    """
    _set_folders([str(installation()), *_folders()])


@contextlib.contextmanager
def restored() -> Iterator[None]:
    """Take back, at the end, what a parsed scene adds to Mitsuba's file resolver."""
    before = _folders()
    try:
        yield
    finally:
        _set_folders(before)


def check(name: str, where: str) -> None:
    """Refuse the name of a plugin that the installation lacks and a file elsewhere would provide.

    A name that is neither is left to Mitsuba, which knows what a program has registered in Python. InputError
    names ``where`` and the file.
    """
    if not _NAME.fullmatch(name):
        raise InputError(f"{where}: type is {name[:60]!r}, expected the name of a Mitsuba plugin")
    files = [f"{name}{suffix}" for suffix in _SUFFIXES]
    if any((installation() / "plugins" / file).is_file() for file in files):
        return
    for folder in (*_folders(), "."):
        for file in files:
            if os.path.lexists(elsewhere := Path(folder) / "plugins" / file):
                raise InputError(
                    f"{where}: Mitsuba has no plugin {name}, and {elsewhere} is not loaded; "
                    "plugins are taken from Mitsuba's installation only"
                )


def check_dict(scene: dict, where: str) -> None:
    """Check, as :func:`check`, every ``type`` in a scene given as a dict."""
    waiting = [scene]
    while waiting:
        table = waiting.pop()
        if isinstance(kind := table.get("type"), str):
            check(kind, where)
        waiting += [value for value in table.values() if isinstance(value, dict)]


def _folders():
    return [str(folder) for folder in mi.file_resolver()]


def _set_folders(folders):
    resolver = mi.file_resolver()
    resolver.clear()
    for folder in dict.fromkeys(folders):
        resolver.append(folder)
