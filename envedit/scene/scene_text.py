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
from dataclasses import dataclass, field
from pathlib import Path

import mitsuba as mi

from envedit.core.errors import InputError
from envedit.images.headers import shown
from envedit.scene import scene_files

DEEPEST = 20
"""Elements inside one another, and objects that refer to one another: scenes have 10 or so, and Mitsuba's
time doubles with every ``twosided`` inside another, to 0.3 s at 20."""
MOST_BYTES, MOST_ELEMENTS = 2**26, 1_000_000
"""Of a scene with all it includes."""
MOST_INCLUDED = 1000
"""Files, counted as often as they are included."""
MOST_DEFAULTS = 1000
MOST_VALUE, MOST_VALUES = 2**16, 2**26
"""Characters of a value whose ``$names`` are filled in, and of all of them."""
_INCLUDES_DEEP = 15  # Mitsuba's own bound

_TAG = re.compile(r"""<(/?)([A-Za-z_:][\w:.-]*)((?:[^<>"']|"[^"]*"|'[^']*')*+)>""")
_ATTRIBUTE = re.compile(r"""([\w:.-]+)\s*=\s*(?:"([^"]*)"|'([^']*)')""")
_NAME = re.compile(r"\$\{?([A-Za-z_]\w*)")
_SKIPPED = {"<!--": ("-->", "comment"), "<![CDATA[": ("]]>", "CDATA section"), "<?": ("?>", "instruction")}


@dataclass
class Outline:
    """What the text of a scene contains, with all it includes.

    Attributes
    ----------
    used, defaults : set of str
        Names after ``$``, and those with a ``<default>``.
    folders : list of Path
        Of ``<path value="...">``, in order.
    files : list of str
        What it includes, and the values of properties called ``filename``.
    """

    used: set[str] = field(default_factory=set)
    defaults: set[str] = field(default_factory=set)
    folders: list[Path] = field(default_factory=list)
    files: list[str] = field(default_factory=list)


def read(path: Path, parameters: dict[str, str]) -> Outline:
    """Read a scene and all that it includes, with the values given for its ``$names``.

    Raises
    ------
    InputError
        If a file cannot be read, is no XML, or goes beyond a bound; naming file and line.
    """
    reader = _Reader(dict(parameters))
    reader.file(Path(path), [str(f) for f in mi.file_resolver()], [])
    return reader.outline


def check_references(state: mi.parser.ParserState, where: str) -> None:
    """Refuse a parsed scene whose objects refer to one another too deeply for Mitsuba's recursion.

    Raises
    ------
    InputError
        If a chain is longer than :data:`DEEPEST`. Circles are left to Mitsuba, unless they are as long.
    """
    named = dict(state.id_to_index)
    below = []
    for node in state.nodes:
        values = [value for _, value in node.props.items()]
        ids = [named.get(v.id()) for v in values if isinstance(v, mi.Properties.Reference)]
        held = [v.index() for v in values if isinstance(v, mi.Properties.ResolvedReference)]
        below.append([index for index in (*ids, *held) if index is not None])
    # Height of every node, children first; a node on the path is a circle and counts as a leaf.
    height, path = [0] * len(below), set()
    for start in range(len(below)):
        stack = [] if height[start] else [(start, iter(below[start]))]
        while stack:
            node, children = stack[-1]
            path.add(node)
            child = next((c for c in children if not height[c] and c not in path), None)
            if child is not None:
                stack.append((child, iter(below[child])))
                continue
            height[node] = 1 + max((height[c] for c in below[node]), default=0)
            path.discard(node)
            stack.pop()
            if height[node] > DEEPEST:
                raise InputError(f"{where}: objects refer to one another more than {DEEPEST} deep")


class _Reader:
    def __init__(self, parameters):
        self.outline, self.parameters = Outline(), parameters
        self.bytes = self.elements = self.files = self.values = 0

    def file(self, path, folders, above):
        """Read one file, whose folders are searched in this order; ``above``: the files that include it."""
        name = str(path)
        real = os.path.realpath(name)
        if real in above:
            raise InputError(f"scene {name}: includes itself")
        self.files += 1
        if self.files > MOST_INCLUDED or len(above) >= _INCLUDES_DEEP:
            raise InputError(
                f"scene {name}: more than {MOST_INCLUDED} files are included, or more than "
                f"{_INCLUDES_DEEP} inside one another"
            )
        text = self._text(path, above)
        folders = [os.path.dirname(name), *folders] if os.path.dirname(name) else list(folders)
        self._tags(text, name, folders, [*above, real])

    def _text(self, path, above):
        size = scene_files.size_of(path, "an XML file")
        self.bytes += size
        if self.bytes > MOST_BYTES:
            raise InputError(f"scene {path}: more than {MOST_BYTES >> 20} MB of XML with what it includes")
        try:
            text = path.read_bytes()
        except OSError as error:
            raise InputError(f"scene {path}: {error.strerror or error}") from None
        text = text.decode("utf-8-sig", "replace")
        if "\0" in text or not text.lstrip().startswith("<"):
            which = f"{above[-1]}: includes {path}, which" if above else f"{path}:"
            raise InputError(f"scene {which} is no XML file in UTF-8")
        return text

    def _tags(self, text, name, folders, above):
        place, depth = 0, 0

        def wrong(what):
            line = text.count("\n", 0, place) + 1
            return InputError(f"scene {name}, line {line}: {what}")

        while (place := text.find("<", place)) >= 0:
            if found := _TAG.match(text, place):
                end, tag, attributes = found.end(), found[2], found[3]
                self.elements += 1
                if self.elements > MOST_ELEMENTS:
                    raise wrong(f"more than {MOST_ELEMENTS} elements")
                if found[1]:
                    depth -= 1
                    place = end
                    continue
                depth += not attributes.endswith("/")
                if depth > DEEPEST:
                    raise wrong(f"more than {DEEPEST} elements inside one another")
                self.outline.used.update(_NAME.findall(attributes))
                try:
                    self._tag(tag, attributes, name, folders, above)
                except _WrongError as error:
                    raise wrong(str(error)) from None
                place = end
                continue
            for start, (stop, what) in _SKIPPED.items():
                if text.startswith(start, place):
                    end = text.find(stop, place + len(start))
                    if end < 0:
                        raise wrong(f"a {what} is not closed")
                    place = end + len(stop)
                    break
            else:
                doctype = text.startswith("<!", place)
                raise wrong("a DOCTYPE is not read; remove it" if doctype else "a tag is not well formed")

    def _tag(self, tag, attributes, name, folders, above):
        values: dict[str, str] = {}
        for key, double, single in _ATTRIBUTE.findall(attributes):
            raw = html.unescape(double or single)
            values.setdefault(key, self._filled(raw) if "$" in raw else raw)
        if tag == "default" and "name" in values:
            self.outline.defaults.add(values["name"])
            self.parameters.setdefault(values["name"], values.get("value", ""))
            if len(self.parameters) > MOST_DEFAULTS:
                raise _WrongError(f"more than {MOST_DEFAULTS} parameters")
        elif tag == "path" and "value" in values:
            folder = _resolved(values["value"], folders)
            self.outline.folders.append(Path(folder))
            folders.insert(0, folder)
        elif tag == "include" and "filename" in values:
            found = _resolved(values["filename"], folders)
            if not os.path.isfile(found):
                raise _WrongError(f"includes a missing file: {shown(values['filename'], 200)}")
            self.outline.files.append(os.path.abspath(found))
            self.file(Path(found), folders, above)
        elif tag == "spectrum" and values.get("filename"):
            self.outline.files.append(values["filename"])
            scene_files.check_numbers(Path(_resolved(values["filename"], folders)))
        elif values.get("name") == "filename" and "value" in values:
            self.outline.files.append(values["value"])

    def _filled(self, value):
        """Fill in ``$names``, the longest name first, as Mitsuba does."""
        for key in sorted(self.parameters, key=len, reverse=True):
            name, filling = "$" + key, self.parameters[key]
            if name not in value:
                continue
            parts: list[str] = []
            place, size = 0, 0
            for piece in value.split(name)[:-1]:
                escaped = (piece or (parts[-1] if parts else "")).endswith("\\")
                parts += [piece, name if escaped else filling]
                size += len(parts[-2]) + len(parts[-1])
                place += len(piece) + len(name)
                if size > MOST_VALUE:
                    break
            value = "".join(parts) + value[place:]
            if len(value) > MOST_VALUE:
                raise _WrongError(f"${key} makes a value longer than {MOST_VALUE} characters")
        self.values += len(value)
        if self.values > MOST_VALUES:
            raise _WrongError(f"values with $names are longer than {MOST_VALUES} characters in all")
        return value.replace("\\$", "$")


class _WrongError(Exception):
    """What is wrong with a tag, to be said with its place."""


def _resolved(name, folders):
    """Find a file as Mitsuba's resolver does: in the first folder that has it."""
    if not os.path.isabs(name):
        for folder in folders:
            if os.path.exists(found := os.path.join(folder, name)):
                return found
    return name
