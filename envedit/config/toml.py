r"""From TOML to a configuration and back: the only module that knows TOML.

A value comes from the last of these that gives it: the dataclass default, the preset, what the preset has for
the kinds of representation and target, the file, a ``--set table.key=value`` override. Each layer is checked
by itself, so that an error names the place the value came from.

>>> config = loads("[fit]\nepochs = 100", preset="draft", overrides=["seed=3"])
>>> config.fit.epochs, config.representation.hidden, config.seed
(100, 64, 3)
"""

from __future__ import annotations

import difflib
import json
import re
import tomllib
from collections.abc import Iterable
from os import PathLike
from pathlib import Path
from typing import Any

from envedit.config import presets
from envedit.config.schema import FIELDS, TOP, Config
from envedit.config.tables import checked
from envedit.config.validators import meant, show
from envedit.core.atomic_files import opened
from envedit.core.errors import ConfigError

_MOST_BYTES = 1 << 20  # more than any configuration; an EXR given by mistake is not read to its end
# a.b.c...: tomllib takes time and memory with the square of the parts, gigabytes for a file of 100 kB.
_LONG_KEY = re.compile(r"""(?<![\w-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){100}""", re.ASCII)


def load(path: str | PathLike[str], preset: str | None = None, overrides: Iterable[str] = ()) -> Config:
    """Read a configuration file.

    ``path`` is TOML in UTF-8; relative paths in it, and in overrides, are relative to its folder. ``preset``
    beats the one that the file or an override names. ``overrides`` are ``"table.key=value"``, of which later
    ones beat earlier ones; the value is TOML, and what is not TOML is a string. The result is resolved: every
    path absolute, ``output.dir`` filled in. ConfigError if the file cannot be read, is not TOML, or holds an
    unknown key or an unusable value.
    """
    try:
        with opened(path) as file:
            data = file.read(_MOST_BYTES + 1)
    except IsADirectoryError:
        raise ConfigError(f"{path}: a folder, expected a TOML file") from None
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such configuration file") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ConfigError(f"{str(path)!r}: cannot be read: {reason}") from None
    if len(data) > _MOST_BYTES:
        raise ConfigError(f"{path}: more than {_MOST_BYTES >> 20} MiB, expected a TOML file")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        row = data.count(b"\n", 0, error.start) + 1
        raise ConfigError(f"{path}: not UTF-8 text at line {row}; expected a TOML file") from None
    path = Path(path)
    return loads(text, path.absolute().parent, str(path), preset, overrides)


def loads(
    text: str,
    base_dir: str | PathLike[str] = ".",
    name: str = "config.toml",
    preset: str | None = None,
    overrides: Iterable[str] = (),
) -> Config:
    """Read a configuration from TOML text; errors, ``preset`` and ``overrides`` as in `load`.

    Relative paths start from ``base_dir``. ``name`` is what errors call the document; its stem names the
    output folder.
    """
    return from_dict(parsed(text, name), base_dir, name, preset, overrides)


def parsed(text: str, name: str) -> dict[str, Any]:
    """Parse the text of a file; ConfigError with its name if it is not TOML."""
    if found := _LONG_KEY.search(text):
        row = text.count("\n", 0, found.start()) + 1
        raise ConfigError(f"{name}: not TOML: a key of more than 100 parts (at line {row})")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ConfigError(f"{name}: not TOML: nested too deeply") from None
    except ValueError as error:  # TOMLDecodeError, or an integer of thousands of digits
        reason = str(error)
        if len(reason) > 200:  # it may hold a key of any length; its end says where
            reason = f"{reason[:120]} ... {reason[-60:]}"
        raise ConfigError(f"{name}: not TOML: {reason}") from None


def from_dict(
    table: dict[str, Any],
    base_dir: str | PathLike[str] = ".",
    name: str = "config.toml",
    preset: str | None = None,
    overrides: Iterable[str] = (),
) -> Config:
    """Build a configuration from nested dicts with the tables and keys of the TOML file; see `loads`."""
    assigned: dict[str, Any] = {}
    for text in overrides:
        keys, value = parse_override(text)
        layer: Any = value
        for key in reversed(keys):
            layer = {key: layer}
        layer = _checked_layer(layer, f"--set {show(text)}")
        assigned = presets.overlaid(assigned, layer)
    file = _checked_layer(_replaced(table, assigned), name)

    chosen = assigned.get("preset", file.get("preset", "standard"))
    if preset is not None:
        chosen = checked(TOP["preset"], "preset", preset)
    given = presets.overlaid(file, assigned)
    merged = given | {"preset": chosen}
    merged["target"] = presets.one_target(merged, (file, assigned))
    try:
        presets.resolve_paths(merged, Path(base_dir).absolute(), Path(name).stem or "config")
        tables = {key: TOP[key].metadata["table"](**merged.pop(key, {})) for key in FIELDS}
        return Config(**merged, **tables)
    except ConfigError as error:
        raise ConfigError(f"{name}: {error}") from None


def _replaced(table: Any, assigned: Any) -> Any:
    """Return what a file gives with the values of overrides in place of its own, which may be unusable."""
    if not isinstance(table, dict):
        return table
    replaced = {}
    for key, value in table.items():
        other = assigned.get(key, value)
        both = isinstance(value, dict) and isinstance(other, dict)
        replaced[key] = _replaced(value, other) if both else other
    return replaced


def _checked_layer(layer: Any, where: str) -> dict[str, Any]:
    """Check every table, key and value that one source gives, and normalise the values."""
    if not isinstance(layer, dict):
        raise ConfigError(f"{where}: got {show(layer)}, expected a table of tables")
    found: dict[str, Any] = {}
    try:
        for name, value in layer.items():
            if name in FIELDS:
                if not isinstance(value, dict):
                    raise ConfigError(f"{name}: got {show(value)}, expected a table, [{name}]")
                found[name] = {}
                for key, entry in value.items():
                    if key not in FIELDS[name]:
                        raise ConfigError(_unknown(key, name))
                    found[name][key] = checked(FIELDS[name][key], f"{name}.{key}", entry)
            elif name in TOP:
                found[name] = checked(TOP[name], name, value)
            else:
                raise ConfigError(_unknown(name, ""))
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None
    return found


def _unknown(key: Any, table: str) -> str:
    """Say that a key is unknown, with the nearest name: of its own table first, then of any other."""
    own = FIELDS[table] if table else TOP
    text = key[:60] if isinstance(key, str) else ""
    shown = key if text == key and re.fullmatch(r"[\w-]{1,60}", text) else show(key)
    kind = f"[{table}] has no key {shown}" if table else f"unknown table or key {shown}"
    elsewhere = {k: f"{name}.{k}" for name, keys in FIELDS.items() for k in keys} | {k: k for k in TOP}
    close = difflib.get_close_matches(text, elsewhere, 1, 0.8)
    hint = f"did you mean {elsewhere[close[0]]}?" if close else None
    return f"{kind}; {meant(key, own, hint)}"


def parse_override(text: str) -> tuple[tuple[str, ...], Any]:
    """Split ``"table.key=value"`` into the key's parts and the value.

    The value is parsed as TOML; what is not TOML is taken as a string, so words and paths need no quotes.

    >>> parse_override("fit.epochs=10"), parse_override("input.envmap=maps/sky.exr")
    ((('fit', 'epochs'), 10), (('input', 'envmap'), 'maps/sky.exr'))

    ConfigError if there is no ``=``, or a part of the key is empty.
    """
    key, equals, raw = text.partition("=") if isinstance(text, str) else ("", "", "")
    keys = tuple(part.strip() for part in key.split("."))
    if not equals or not all(keys):
        raise ConfigError(f"--set {show(text)}: expected table.key=value, such as fit.epochs=100")
    raw = raw.strip()
    try:
        table = parsed(f"value = {raw}", "--set")
    except ConfigError:
        return keys, raw
    # A value with a line break could smuggle in a second key.
    return keys, table["value"] if table.keys() == {"value"} else raw


# ---- Writing -----------------------------------------------------------------------------------------------


def to_toml(config: Config) -> str:
    """Write a configuration, every key spelled out.

    A configuration that came from `load`, `loads` or `from_dict` loads back to an equal one from any folder,
    as its paths are absolute.
    """
    lines = [f"{key} = {quote(getattr(config, key))}" for key in TOP if key not in FIELDS]
    for name, keys in FIELDS.items():
        table = getattr(config, name)
        lines += ["", f"[{name}]", *(f"{key} = {quote(getattr(table, key))}" for key in keys)]
    return "\n".join(lines) + "\n"


def quote(value: Any) -> str:
    """Write a value as TOML on one line."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # JSON's escapes are TOML's, but for DEL, which only TOML requires to be escaped.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, dict):
        bare = {k: k if re.fullmatch(r"[A-Za-z0-9_-]+", k) else quote(k) for k in value}
        return f"{{ {', '.join(f'{bare[k]} = {quote(v)}' for k, v in value.items())} }}" if value else "{}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(quote, value))}]"
    return repr(value)
