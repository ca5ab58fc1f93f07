"""The configuration as JSON Schema and as the page ``docs/configuration.md``: ``envedit schema``.

Both are written from the fields, their checks and the presets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import MISSING, Field
from typing import Any

from envedit.config.list_schema import LIGHT_SIZE
from envedit.config.presets import MANY_PARAMETERS, PAINTED, PRESETS, SIREN
from envedit.config.schema import FIELDS, TOP, Config
from envedit.config.toml import quote
from envedit.config.unused import condition, conditions
from envedit.config.validators import Schema

_HEAD = """\
<!-- Generated: envedit schema --markdown > docs/configuration.md -->
# The configuration

Every key of a TOML file, and so of `--set table.key=value`, `envedit.Config` and the dicts that
`envedit.edit` takes. No key is needed. `envedit init` writes a file to start from,
[getting started](getting_started.md) explains its parts, and `config.toml` among the results has every key.

**Where a value comes from.** The last of these that gives it: the default; the preset (`--preset`, or the key
`preset`); what the preset has for the kind of representation and of target ([below](#defaults-of-a-kind));
the file; `--set`, of which the last counts. Paths, those in `--set` too, are relative to the file, or
to the working folder where a shipped name or a scene stands in its place.

**Keys without effect.** A key that has a meaning *only where* another has some value changes nothing
elsewhere. Where it is given, and differs from its default, the run names it in a warning. Keys that
contradict each other are refused.

**The other map and the turn.** A target of kind `envmap` is rendered under the map that `target.file` names,
or under the input turned by `target.rotate_degrees`. Both together are refused, and neither changes the
other: `rotate_degrees = "auto"`, the default, is 60 degrees where no file is named. In `--set`, one of them
replaces the other that the file gives.

**In an editor.** `envedit schema > envedit.schema.json` writes a JSON Schema. With
`#:schema envedit.schema.json` in the first line of a TOML file, editors that have Taplo ("Even Better TOML")
complete its keys and check them.
"""


_ENTRIES = {
    "input.lights": "A light of the map (with `light`), or one that is added; see "
    "[by hand](painting.md#move-lights). Radius of an added light where none is given: "
    f"{LIGHT_SIZE:g} degrees.",
    "input.regions": "A region has one shape: points or polygon; see [regions of the map](regions.md).",
    "target.strokes": "What each type does is said in [painting](painting.md). A stroke has one shape: "
    "points, polygon, ellipse or rectangle; temperature, contrast and blur may have none.",
}
"""What is said above the keys of each list of tables."""


def json_schema() -> Schema:
    """Return the configuration as JSON Schema, draft 7, which editors know.

    It accepts all that the configuration does. What depends on several keys, on the shape of a stroke or on
    single precision is left to the run.
    """
    properties: Schema = {}
    for name, top in TOP.items():
        if name not in FIELDS:
            properties[name] = _key(top, "")
            continue
        keys = {key: _key(f, condition(conditions(name, key))) for key, f in FIELDS[name].items()}
        about = (top.metadata["table"].__doc__ or "").partition("\n\n")[0]
        properties[name] = {"type": "object", "description": about, "properties": keys}
        properties[name]["additionalProperties"] = False
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": "Configuration of envedit",
        "type": "object",
        "properties": properties,
        "additionalProperties": False,
    }


def _key(f: Field[Any], only: str) -> Schema:
    """Return the schema of a key: what it may be, its meaning and unit, and its default."""
    about, unit = f.metadata["doc"], f.metadata["unit"]
    about = f"{about} [{unit}]" if unit else about
    default = f.default_factory() if f.default_factory is not MISSING else f.default
    default = list(default) if isinstance(default, tuple) else default
    check: Schema = f.metadata["check"].schema()
    return {**check, "description": f"{about}; {only}" if only else about, "default": default}


def markdown() -> str:
    """Return the reference as Markdown."""
    schema = json_schema()["properties"]
    presets = [Config(preset=preset) for preset in PRESETS]
    top = {key: schema[key] for key in TOP if key not in FIELDS}
    parts = [_HEAD, _section("## Top of the file", "", top, presets)]
    for name in FIELDS:
        table = schema[name]
        defaults = [getattr(preset, name) for preset in presets]
        parts.append(_section(f"## [{name}]", table["description"], table["properties"], defaults))
        for key, about in _ENTRIES.items():
            if key.startswith(f"{name}."):
                entries = table["properties"][key.removeprefix(f"{name}.")]["items"]
                parts.append(_section(f"### [[{key}]]", about, entries["properties"]))
    return "\n".join([*parts, _kinds()])


def _section(title: str, about: str, properties: Schema, presets: Sequence[Any] = ()) -> str:
    """Return the section of some keys; ``presets``: what has their defaults in each preset."""
    rows = []
    for key, schema in properties.items():
        defaults = [f"`{quote(getattr(preset, key))}`" for preset in presets]
        rows.append([f"`{key}`", values(schema), *defaults, schema["description"]])
    head = ["key", "values", *(PRESETS if presets else ()), "meaning"]
    return "\n\n".join(filter(None, (title, about, _table(head, rows))))


def values(schema: Schema) -> str:
    """Say in a few words what a JSON Schema of :mod:`.validators` accepts."""
    match schema:
        case {"anyOf": options}:
            return "; or ".join(map(values, options))
        case {"enum": names}:
            return ", ".join(f'"{name}"' for name in names)
        case {"type": "array", "items": [*items]}:
            each = {values(item) for item in items}
            return f"list of {len(items)}" + (f": {each.pop()}" if len(each) == 1 else " numbers")
        case {"type": "array", "items": item}:
            inner = f"({values(item)})" if "anyOf" in item or "items" in item else values(item)
            inner += "s" * inner.isalpha()
            return f"list of {inner}" + _bounds(schema.get("minItems"), schema.get("maxItems"), ", ")
        case {"type": "object"}:
            return "table"
        case {"minimum": low, "maximum": high} if low == high:
            return str(low)
    low, high = schema.get("minimum"), schema.get("maximum")
    if "exclusiveMinimum" in schema:
        low = f"above {schema['exclusiveMinimum']}"
    even = ", even" if "multipleOf" in schema else ""
    return f"{schema['type']}{_bounds(low, high, ' ')}{even}"


def _bounds(low: Any, high: Any, before: str) -> str:
    """Say between which bounds something is, of which each may be None."""
    low, high = (f"{bound:g}" if isinstance(bound, float) else bound for bound in (low, high))
    if low is None:
        return "" if high is None else f"{before}at most {high}"
    if high is None:
        return before + (low if str(low).startswith("above") else f"at least {low}")
    return f"{before}{low} to {high}"


def _kinds() -> str:
    """Return the defaults that follow the kind of representation and of target."""
    rows = []
    painted = '`target.kind = "image" | "strokes"`'
    many = '`representation.kind = "siren" | "pixels" | "log-pixels"`'
    siren = '`representation.kind = "siren"`'
    for where, kinds in ((many, MANY_PARAMETERS), (siren, SIREN), (painted, PAINTED)):
        for preset, tables in kinds.items():
            for table, keys in tables.items():
                rows += [[where, preset, f"`{table}.{key}`", f"`{quote(v)}`"] for key, v in keys.items()]
    head = ["with", "preset", "key", "default"]
    return f"## Defaults of a kind\n\n{_table(head, rows)}"


def _table(head: list[str], rows: list[list[Any]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    cells = [[str(cell).replace("|", "\\|") for cell in line] for line in lines]
    return "".join(f"| {' | '.join(line)} |\n" for line in cells)
