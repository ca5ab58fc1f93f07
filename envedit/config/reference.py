"""The reference of the configuration, ``docs/configuration.md``: ``envedit schema --markdown``.

Written from the fields, their checks and the presets, so that it cannot differ from them; a test compares.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from envedit.config import light_schema, region_schema, stroke_schema
from envedit.config.presets import MANY_PARAMETERS, PAINTED, PRESETS, SIREN
from envedit.config.schema import FIELDS, TOP, Config
from envedit.config.toml import quote
from envedit.config.unused import condition
from envedit.config.validators import Check

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


def markdown() -> str:
    """Return the reference as Markdown."""
    made = {preset: Config(preset=preset) for preset in PRESETS}
    parts = [_HEAD, _keys("Top of the file", "", [k for k in TOP if k not in FIELDS], made)]
    for name, keys in FIELDS.items():
        about = (TOP[name].metadata["table"].__doc__ or "").partition("\n\n")[0]
        if only := condition(TOP[name].metadata["when"]):
            about += f" {only[0].upper()}{only[1:]}."
        parts.append(_keys(f"[{name}]", name, keys, made, about))
        if name == "input":
            parts += [_lights(), _regions()]
        if name == "target":
            parts.append(_strokes())
    return "\n".join([*parts, _kinds()])


def _keys(title: str, table: str, keys: Iterable[str], made: Mapping[str, Config], about: str = "") -> str:
    """Return the section of a table."""
    rows = []
    for key in keys:
        f = FIELDS[table][key] if table else TOP[key]
        only = condition(f.metadata["when"])
        meaning = f.metadata["doc"] + (f"; *{only}*" if only else "")
        defaults = [getattr(getattr(c, table) if table else c, key) for c in made.values()]
        if key == "preset":
            defaults = ["standard"] * len(made)
        shown = [f"`{quote(value)}`" for value in defaults]
        rows.append([f"`{key}`", _values(f.metadata["check"]), f.metadata["unit"], *shown, meaning])
    head = ["key", "values", "unit", *made, "meaning"]
    return f"## {title}\n\n{about}{'' if not about else chr(10) * 2}{_table(head, rows)}"


def _values(check: Check) -> str:
    """Return type and range in a cell."""
    return f"{check.kind}: {check.range}" if check.range else check.kind


def _lights() -> str:
    rows = []
    for key, about in light_schema.MEANINGS.items():
        checks = [keys[key] for keys in (light_schema.OWN, light_schema.ADDED) if key in keys]
        rows.append([f"`{key}`", " / ".join(dict.fromkeys(map(_values, checks))), about])
    default = f"Radius of an added light where none is given: {light_schema.SIZE:g} degrees."
    about = "A light of the map (with `light`), or one that is added; see [by hand](painting.md#move-lights)."
    return f"### [[input.lights]]\n\n{about} {default}\n\n{_table(['key', 'values', 'meaning'], rows)}"


def _regions() -> str:
    rows = [[f"`{key}`", _values(check), meaning] for key, (check, meaning) in region_schema.KEYS.items()]
    about = "A region has one shape: points or polygon; see [regions of the map](regions.md)."
    return f"### [[input.regions]]\n\n{about}\n\n{_table(['key', 'values', 'meaning'], rows)}"


def _strokes() -> str:
    rows = []
    for key, checks in stroke_schema.stroke_keys().items():
        defaults: dict[str, str] = {}
        for kind, keys in (*stroke_schema.STROKES.items(), ("", stroke_schema.ANY_STROKE)):
            if key in keys:
                value = keys[key][0]
                shown = "needed" if value is None else f"`{quote(value)}`"
                defaults[kind] = f"{kind}: {shown}" if kind else shown
        values = " / ".join(dict.fromkeys(map(_values, checks)))
        rows.append([f"`{key}`", values, ", ".join(defaults.values()), stroke_schema.MEANINGS[key]])
    about = "What each type does is said in [painting](painting.md). A stroke has one shape: points, polygon,"
    about += " ellipse or rectangle; temperature, contrast and blur may have none."
    return f"### [[target.strokes]]\n\n{about}\n\n{_table(['key', 'values', 'default', 'meaning'], rows)}"


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
