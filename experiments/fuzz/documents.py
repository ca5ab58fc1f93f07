"""Configurations: whole ones, and damage that a text editor or a script could do to them."""

import numpy as np

from envedit import config

from . import mutate
from .mutate import one_of

WRITTEN = """\
preset = "draft"
seed = 7

[input]
envmap = "maps/sky.exr"
width = 128
rows = [0, 40]

[scene]
file = "statue"
parameters = { roughness = 0.5, mesh = "a.ply", smooth = true }

[target]
kind = "strokes"

[[target.strokes]]
type = "shadow"
ellipse = [0.5, 0.7, 0.2, 0.1, 15]
amount = 0.6

[[target.strokes]]
type = "light"
points = [[0.1, 0.2], [0.3, 0.4]]
width = 0.05
color = [1.0, 0.8, 0.5]

[loss]
ssim = [1.0, 100.0]
tv = 1e-3

[optimizer]
lr = "auto"
iterations = 50
"""

VALUES = (
    "0", "-1", "1", "2147483647", "-2147483648", "9223372036854775807", "99999999999999999999", "0xff", "0b1",
    "1e400", "-1e400", "1e-320", "nan", "-nan", "inf", "-inf", "0.0", "-0.0", "1e38", "1e39", "0.5", "1_0.0",
    "true", "false", '""', '"auto"', '"sunsky"', '"layers"', '"image"', '"upper"', "'a\\b'", '"\\u0000"',
    '"\\uD800"', '"\\U0001F600"', '"""\na\n"""', "'''", '"', "[]", "[1.0, 2.0]", "[1, [2]]", "{}",
    "{ a = 1 }", "{ a.b = [] }", "{", "[", "]", "1979-05-27T07:32:00Z", "07:32:00", "1979-05-27", "\x00",
    "# gone", "=", "[nan, inf]", "[1, 0]",
    '[{ type = "blur" }]', '[{ type = "shadow", points = [[0, 0]], width = 1e9 }]', "[[1]]", "'../../etc'",
)  # fmt: skip
"""What a value becomes."""
ODD = (
    "\0", "\x1b[31m", "\ufeff", "\u2028", "\udcff", "\udcc3(", "\x7f", "\x85", "\u202e", "\t", "\\", '"',
    "\r",
)  # fmt: skip
"""What is put into a line."""


def toml_files() -> dict[str, bytes]:
    """Return whole configurations: by hand, and presets and kinds with every key spelled out."""
    files = {"written.toml": WRITTEN.encode()}
    for preset in config.preset_names():
        for kind in ("layers", "siren", "pixels"):
            chosen = config.loads(f'representation.kind = "{kind}"', "/maps", "a.toml", preset)
            files[f"{preset}-{kind}.toml"] = config.to_toml(chosen).encode()
    painted = '[target]\nkind = "image"\nfile = "é/paint.png"\n'
    files["painted.toml"] = config.to_toml(config.loads(painted, "/maps")).encode()
    return files


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """Return a damaged copy of a configuration.

    A third has its bytes damaged like any file, the others one to three of: values of other types, sizes and
    kinds, keys and values swapped, keys renamed, lines and tables doubled, removed and moved, deep nesting,
    numbers and names of thousands of characters, NUL, and bytes that are no UTF-8.
    """
    if rng.random() < 1 / 3:
        return mutate.mutated(data, rng)
    lines = data.decode().splitlines()
    for _ in range(mutate.few(rng)):
        _damage(lines, rng.integers(11), rng)
    raw = "\n".join(lines).encode("utf-8", "surrogateescape")
    if rng.random() < 0.1:
        raw = raw.replace(b"\n", b"\r\n" if rng.random() < 0.5 else b"\r")
    return raw[: mutate.MOST_BYTES]


def _pick(lines, rng, equals=True):
    """Return the index of a line; of one with a key, if there is any."""
    if not lines:
        lines.append("")
    keyed = [i for i, line in enumerate(lines) if "=" in line] if equals else []
    return one_of(keyed or range(len(lines)), rng)


def _damage(lines, kind, rng):
    """Change lines in one of nine ways, of which three numbers mean the first."""
    match kind:
        case 0 | 1 | 2:
            at = _pick(lines, rng)
            lines[at] = f"{lines[at].partition('=')[0]}= {one_of(VALUES, rng)}"
        case 3:
            one, other = _pick(lines, rng), _pick(lines, rng)
            (a, _, b), (c, _, d) = lines[one].partition("="), lines[other].partition("=")
            lines[one], lines[other] = f"{a}={d}", f"{c}={b}"
        case 4:
            at = _pick(lines, rng)
            key, _, value = lines[at].partition("=")
            keys = (
                key[:-2], key.strip() * 2, value, key.upper(), "", f'"{key}"', "a.b", "'\t'", "é",
                "input.width", "scene.parameters.x", "preset", '"\\u2028\\n"', f"{key.strip()}.more",
            )  # fmt: skip
            lines[at] = f"{one_of(keys, rng)}={value}"
        case 5:
            lines.insert(rng.integers(len(lines) + 1), lines[_pick(lines, rng, rng.random() < 0.5)])
        case 6:
            del lines[_pick(lines, rng, rng.random() < 0.5)]
        case 7:
            name = one_of([line for line in lines if line.startswith("[")] or ["[input]"], rng).strip("[]")
            forms = (
                f"[{name}]", f"[[{name}]]", f"[{name}.more]", f"[{name.upper()}]", "[]", "[", f"[{name}",
                f"{name} = 1",
            )  # fmt: skip
            lines.insert(rng.integers(len(lines) + 1), one_of(forms, rng))
        case 8 | 9:
            at, count = _pick(lines, rng), int(2 ** rng.uniform(5, 15))
            key = lines[at].partition("=")[0] or "a"
            lines[at] = one_of((_deep if kind == 8 else _wide)(key, count), rng)
        case 10:
            at = _pick(lines, rng, False)
            place = rng.integers(len(lines[at]) + 1)
            lines[at] = lines[at][:place] + one_of(ODD, rng) + lines[at][place:]


def _deep(key, count):
    """Return lines with arrays, tables and keys nested in one another."""
    return (
        f"{key}= {'[' * count}{']' * count}", f"{key}= {'{a=' * count}1{'}' * count}", f"{'a.' * count}a = 1",
        f"[{'a.' * count}a]\n[{'a.' * count}a]", f"{key}= {'[' * count}", f'{key}{".b" * count} = {{}}',
    )  # fmt: skip


def _wide(key, count):
    """Return lines with long numbers, names, arrays and tables."""
    return (
        f"{key}= {'9' * count}", f"{key}= 0x{'f' * count}", f"{key}= 0.{'3' * count}", f"{'x' * count} = 1",
        f'{key}= "{"x" * count}"', f"{key}= [{'0, ' * count}]", f"{key}= {' ' * count}", "[[a]]\n" * count,
        f"{key}= 1e{'9' * count}", f"{key}= 1979-05-27T07:32:00.{'9' * count}Z", f"{key}= '{'/a' * count}'",
        f"{key}= {{{', '.join(f'k{i} = {i}' for i in range(count))}}}",
    )  # fmt: skip
