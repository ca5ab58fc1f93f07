"""Configurations: whole ones, and damage that a text editor or a script could do to them."""

import numpy as np

from . import mutate

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


def toml_files() -> dict[str, bytes]:
    """Return whole configurations: by hand, and presets and kinds with every key spelled out."""
    from envedit import config

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
        _LINES[rng.integers(len(_LINES))](lines, rng)
    raw = "\n".join(lines).encode("utf-8", "surrogateescape")
    if rng.random() < 0.1:
        raw = raw.replace(b"\n", b"\r\n" if rng.random() < 0.5 else b"\r")
    return raw[: mutate.MOST_BYTES]


def _pick(lines, rng, equals=True):
    """Return the index of a line; of one with a key, if there is any."""
    keyed = [i for i, line in enumerate(lines) if "=" in line] if equals else []
    choices = keyed or range(len(lines) or 1)
    if not lines:
        lines.append("")
    return choices[rng.integers(len(choices))]


def _long(rng):
    return int(2 ** rng.uniform(5, 15))


def _value(lines, rng):
    at = _pick(lines, rng)
    lines[at] = f"{lines[at].partition('=')[0]}= {VALUES[rng.integers(len(VALUES))]}"


def _exchange(lines, rng):
    one, other = _pick(lines, rng), _pick(lines, rng)
    (a, _, b), (c, _, d) = lines[one].partition("="), lines[other].partition("=")
    lines[one], lines[other] = f"{a}={d}", f"{c}={b}"


def _key(lines, rng):
    at = _pick(lines, rng)
    key, _, value = lines[at].partition("=")
    keys = (
        key[:-2], key.strip() * 2, value, key.upper(), "", f'"{key}"', "a.b", "'\t'", "é", "input.width",
        "scene.parameters.x", "preset", '"\\u2028\\n"', f"{key.strip()}.more",
    )  # fmt: skip
    lines[at] = f"{keys[rng.integers(len(keys))]}={value}"


def _double(lines, rng):
    lines.insert(rng.integers(len(lines) + 1), lines[_pick(lines, rng, rng.random() < 0.5)])


def _remove(lines, rng):
    del lines[_pick(lines, rng, rng.random() < 0.5)]


def _table(lines, rng):
    names = [line for line in lines if line.startswith("[")] or ["[input]"]
    name = names[rng.integers(len(names))].strip("[]")
    forms = (
        f"[{name}]",
        f"[[{name}]]",
        f"[{name}.more]",
        f"[{name.upper()}]",
        "[]",
        "[",
        f"[{name}",
        f"{name} = 1",
    )
    lines.insert(rng.integers(len(lines) + 1), forms[rng.integers(len(forms))])


def _deep(lines, rng):
    at, count = _pick(lines, rng), _long(rng)
    key = lines[at].partition("=")[0] or "a"
    forms = (
        f"{key}= {'[' * count}{']' * count}", f"{key}= {'{a=' * count}1{'}' * count}", f"{'a.' * count}a = 1",
        f"[{'a.' * count}a]\n[{'a.' * count}a]", f"{key}= {'[' * count}", f'{key}{".b" * count} = {{}}',
    )  # fmt: skip
    lines[at] = forms[rng.integers(len(forms))]


def _wide(lines, rng):
    at, count = _pick(lines, rng), _long(rng)
    key = lines[at].partition("=")[0] or "a"
    forms = (
        f"{key}= {'9' * count}", f"{key}= 0x{'f' * count}", f"{key}= 0.{'3' * count}", f"{'x' * count} = 1",
        f'{key}= "{"x" * count}"', f"{key}= [{'0, ' * count}]", f"{key}= {' ' * count}", "[[a]]\n" * count,
        f"{key}= 1e{'9' * count}", f"{key}= 1979-05-27T07:32:00.{'9' * count}Z", f"{key}= '{'/a' * count}'",
        f"{key}= {{{', '.join(f'k{i} = {i}' for i in range(count))}}}",
    )  # fmt: skip
    lines[at] = forms[rng.integers(len(forms))]


def _characters(lines, rng):
    at = _pick(lines, rng, False)
    odd = (
        "\0",
        "\x1b[31m",
        "\ufeff",
        "\u2028",
        "\udcff",
        "\udcc3(",
        "\x7f",
        "\x85",
        "\u202e",
        "\t",
        "\\",
        '"',
        "\r",
    )
    place = rng.integers(len(lines[at]) + 1)
    lines[at] = lines[at][:place] + odd[rng.integers(len(odd))] + lines[at][place:]


_LINES = (_value, _value, _value, _exchange, _key, _double, _remove, _table, _deep, _wide, _characters)
