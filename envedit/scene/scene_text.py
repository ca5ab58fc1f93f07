"""Reading a scene's XML, and what it includes, within bounds, before Mitsuba does.

Mitsuba's parser and its reader of references recurse and expand without bounds: a file of a kilobyte may
crash it or take all memory. The reader here takes time linear in the text, follows includes as Mitsuba
resolves them and substitutes ``$names`` as it does (``src/core/parser.cpp`` of Mitsuba 3.9), so that what it
has let through is what Mitsuba will see.
"""

from __future__ import annotations

import html
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import mitsuba as mi

from envedit.core import atomic_files
from envedit.core.errors import InputError
from envedit.images.headers import shown

DEEPEST = 20
"""Elements inside one another, and objects that refer to one another: scenes have 10 or so, and Mitsuba's
time doubles with every ``twosided`` inside another, to 0.3 s at 20."""
MOST_CHARACTERS = 2**26
"""Of a scene with all that it includes. Beside these an element counts as 64 characters, a file, as often as
it is included, a parameter and a folder as 65,536, and a character of a value with ``$names`` filled in as
16."""
_ELEMENT = 2**6
_FILE = _PARAMETER = _FOLDER = 2**16
_FILLED = 2**4
_INCLUDES_DEEP = 15  # Mitsuba's own bound

_TOKEN = re.compile(
    r"""
    <!--.*?(?:-->|\Z) | <!\[CDATA\[.*?(?:\]\]>|\Z) | <\?.*?(?:\?>|\Z) | (?P<doctype><!)
    | <(?P<closing>/?)(?P<tag>[A-Za-z_:][\w:.-]*)(?P<attributes>(?:[^<>"']|"[^"]*"|'[^']*')*+)>
    | (?P<odd><)
    """,
    re.DOTALL | re.VERBOSE,
)
_ATTRIBUTE = re.compile(r"""([\w:.-]+)\s*=\s*(?:"([^"]*)"|'([^']*)')""")
_NAME = re.compile(r"\$\{?([A-Za-z_]\w*)")


@dataclass
class Outline:
    """What the text of a scene contains, with all it includes."""

    # used, defaults: names after ``$``, and those with a ``<default>``
    used: set[str] = field(default_factory=set)
    defaults: set[str] = field(default_factory=set)
    folders: list[Path] = field(default_factory=list)  # of ``<path value="...">``, in order
    # What it includes, and the values of properties called ``filename``
    files: list[str] = field(default_factory=list)
    # Files of ``<spectrum filename="...">``, which Mitsuba's parser reads
    spectra: list[str] = field(default_factory=list)


def read(path: Path, parameters: dict[str, str]) -> Outline:
    """Read a scene and all that it includes, with the values given for its ``$names``.

    InputError if a file cannot be read, is no XML, or goes beyond a bound; naming file and line.
    """
    reader = _Reader(dict(parameters))
    reader.file(Path(path), [str(folder) for folder in mi.file_resolver()], [])
    return reader.outline


class _Reader:
    def __init__(self, parameters):
        self.outline = Outline()
        self.parameters = parameters
        self.left = MOST_CHARACTERS

    def file(self, path: Path, folders: Sequence[str], above: Sequence[str]) -> None:
        """Read one file, whose folders are searched in this order; ``above``: the files that include it."""
        name = str(path)
        text, place, depth = "", 0, 0
        try:
            text = self._text(path, above)
            folders = [folder for folder in (os.path.dirname(name), *folders) if folder]
            for token in _TOKEN.finditer(text):
                place = token.start()
                if token["doctype"]:
                    raise _WrongError("a DOCTYPE is not read; remove it")
                if token["odd"]:
                    raise _WrongError("a tag is not well formed")
                if token["closing"]:
                    depth -= 1
                elif token["tag"]:
                    if "\ufffd" in token["attributes"]:
                        raise _WrongError("a tag is not in UTF-8; save the file as UTF-8")
                    self._spend(_ELEMENT)
                    depth += not token["attributes"].endswith("/")
                    if depth > DEEPEST:
                        raise _WrongError(f"more than {DEEPEST} elements inside one another")
                    self._tag(token["tag"], token["attributes"], folders, [*above, name])
        except _WrongError as error:
            line = text.count("\n", 0, place) + 1
            raise InputError(f"scene {name}, line {line}: {error}") from None

    def _text(self, path, above):
        if len(above) > _INCLUDES_DEEP:
            raise _WrongError(f"includes are more than {_INCLUDES_DEEP} deep; does a file include itself?")
        try:
            with atomic_files.opened(path) as file:
                self._spend(os.fstat(file.fileno()).st_size + _FILE)
                text = file.read().decode("utf-8-sig", "replace")
        except OSError as error:
            raise InputError(f"scene {path}: {error.strerror or error}") from None
        if "\0" in text or not text.lstrip().startswith("<"):
            which = f"{above[-1]}: includes {path}, which" if above else f"{path}:"
            raise InputError(f"scene {which} is no XML file in UTF-8")
        return text

    def _tag(self, tag, attributes, folders, above):
        self.outline.used.update(_NAME.findall(attributes))
        values: dict[str, str] = {}
        for key, double, single in _ATTRIBUTE.findall(attributes):
            values.setdefault(key, self._filled(html.unescape(double or single)))
        if tag == "default" and "name" in values:
            self._spend(_PARAMETER)
            self.outline.defaults.add(values["name"])
            self.parameters.setdefault(values["name"], values.get("value", ""))
        elif tag == "path" and "value" in values:
            self._spend(_FOLDER)
            folder = _resolved(values["value"], folders)
            self.outline.folders.append(Path(folder))
            folders.insert(0, folder)
        elif tag == "include" and "filename" in values:
            included = _resolved(values["filename"], folders)
            if not os.path.isfile(included):
                raise _WrongError(f"includes a missing file: {shown(values['filename'], 200)}")
            self.outline.files.append(os.path.abspath(included))
            self.file(Path(included), folders, above)
        elif tag == "spectrum" and values.get("filename"):
            self.outline.files.append(values["filename"])
            self.outline.spectra.append(os.path.abspath(_resolved(values["filename"], folders)))
        elif values.get("name") == "filename" and "value" in values:
            self.outline.files.append(values["value"])

    def _filled(self, value):
        """Fill in ``$names``, the longest first as Mitsuba does; after a backslash too, unlike Mitsuba."""
        if "$" not in value:
            return value
        for key in sorted(self.parameters, key=len, reverse=True):
            name = f"${key}"
            if count := value.count(name):
                self._spend(_FILLED * (len(value) + count * len(self.parameters[key])))
                value = value.replace(name, self.parameters[key])
        return value.replace("\\$", "$")

    def _spend(self, characters):
        self.left -= characters
        if self.left < 0:
            raise _WrongError(
                f"the scene with all that it includes and fills in has more than {MOST_CHARACTERS >> 20} MB"
            )


class _WrongError(Exception):
    """What is wrong with a tag, to be said with its place."""


def _resolved(name, folders):
    """Find a file as Mitsuba's resolver does: in the first folder that has it."""
    if not os.path.isabs(name):
        for folder in folders:
            if os.path.exists(path := os.path.join(folder, name)):
                return path
    return name
