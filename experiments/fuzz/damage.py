"""Damage to files: numbers of the header replaced, bits turned, pieces cut, doubled and moved.

Three ways: the bytes of any file, the tokens of a text, the arrays of an archive, under right digests.
"""

import re
import zlib
from typing import NamedTuple

import numpy as np

NUMBERS = (
    0, 1, 2, 3, 7, 8, 127, 128, 255, 256, 4095, 32767, 32768, 65535, 65536, 10**6, 2**27, 2**31 - 1, 2**31,
    2**32 - 1, 2**63, -1, -2,
)  # fmt: skip
"""What a number becomes."""
TEXTS = (*map(str, NUMBERS), "99999999999999999999", "1e9", "-0", "", "nan", "0x10", "16 ")
"""What a decimal number becomes."""
HEAD, TAIL = 600, 200
"""Bytes at the beginning and at the end of a file, where its structure is."""
MOST_BYTES = 1 << 20
"""A file does not grow beyond this."""


def one_of(choices, rng: np.random.Generator):
    """Return one of a sequence."""
    return choices[rng.integers(len(choices))]


def times(rng) -> range:
    """Return how many times a file is damaged, from 1 to 3: mostly once, so that much of it still holds."""
    return range(rng.integers(1, 4) if rng.random() < 0.5 else 1)


def changed(parts, words, rng: np.random.Generator, longest: float) -> None:
    """Change bytes, or a list of tokens, in one of eight ways; words are what may take a part's place.

    Pieces have up to ``longest`` parts.
    """
    size = len(parts)
    start = int(rng.integers(size))
    stop = min(start + int(longest ** rng.random()), size)
    match rng.integers(8):
        case 0 | 1:
            parts[start : start + 1] = one_of(words, rng)
        case 2:
            parts[start:start] = one_of(words, rng)
        case 3:
            del parts[start:stop]
        case 4:
            del parts[start:]
        case 5 | 6:  # repeat a part thousands of times, or a piece up to 128 times
            piece = parts[start:stop] if rng.random() < 0.5 else parts[start : start + 1]
            count = int(2 ** rng.uniform(0, 7 if len(piece) > 1 else 17))
            weight = len(piece) if isinstance(piece, bytearray) else sum(map(len, piece))
            parts[start:start] = piece * min(count, MOST_BYTES // max(weight, 1))
        case 7:  # move a piece over another
            place = int(rng.integers(size))
            parts[place : place + stop - start] = parts[start:stop]


# ---- bytes -------------------------------------------------------------------------------------------------


def of_bytes(data: bytes, rng: np.random.Generator) -> bytes:
    """Return a damaged copy of a file.

    Half of the copies have one to three numbers replaced, or bits turned near the head, the others one to
    three of the ways of :func:`changed`. In half of the PNGs the chunks get correct checksums again, so that
    the damage is not found at the door.
    """
    raw = bytearray(data)
    words = (b"\0", b"\t", b"\n", b" ", b"\x7f", b"\x80", b"\xff", bytes(200), rng.bytes(1), rng.bytes(300))
    numbers = rng.random() < 0.5
    for _ in times(rng):
        if raw and numbers:
            _set_number(raw, rng)
        elif raw:
            changed(raw, words, rng, longest=512)
    if raw.startswith(b"\x89PNG") and rng.random() < 0.5:
        for at, length in png_chunks(raw):
            end = at + 8 + length
            raw[end : end + 4] = zlib.crc32(raw[at + 4 : end]).to_bytes(4, "big")
    return bytes(raw[:MOST_BYTES])


def png_chunks(data: bytes):
    """Yield offset and length of the chunks of a PNG."""
    at = 8
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        yield at, length
        at += 12 + length


def _set_number(raw, rng):
    """Replace a decimal number, or bytes near either end as one number, or turn one of its bits."""
    digits = list(re.finditer(rb"(?<=[\s(,:=\[])\d+(?=[\s),:\]])", bytes(raw)))
    if digits and rng.random() < 0.4:
        found = one_of(digits, rng)
        raw[found.start() : found.end()] = one_of(TEXTS, rng).encode()
        return
    size = one_of((1, 2, 4, 4, 8), rng)
    at = int(rng.integers(min(len(raw), HEAD)))
    if rng.random() < 0.2:
        at = len(raw) - 1 - int(rng.integers(min(len(raw), TAIL)))
    order = one_of(("little", "big"), rng)
    old = int.from_bytes(raw[at : at + size], order)
    bit = old ^ 1 << int(rng.integers(8 * size))
    value = one_of((*NUMBERS, old + 1, old - 1, 2 * old, bit, bit, bit, int(rng.integers(2**63))), rng)
    raw[at : at + size] = (value % 256**size).to_bytes(size, order)


# ---- texts -------------------------------------------------------------------------------------------------


class Grammar(NamedTuple):
    """How a text is damaged."""

    token: str  # regular expression of its parts
    words: tuple[str, ...]  # what a part becomes
    # What opens, is within, and closes: repeated up to 32,768 times
    nests: tuple[tuple[str, str, str], ...]


def of_text(data: bytes, rng: np.random.Generator, grammar: Grammar) -> bytes:
    """Return a damaged copy of a text.

    A third has its bytes damaged like any file; the others have one to three tokens replaced by words or by
    nests, or changed as by :func:`changed`.
    """
    if rng.random() < 1 / 3:
        return of_bytes(data, rng)
    parts = [part for part in re.split(f"({grammar.token})", data.decode()) if part]
    opens, within, closes = one_of(grammar.nests, rng)
    count = int(2 ** rng.uniform(0, 15))
    nest = opens * count + within + closes * (count if rng.random() < 0.8 else 0)
    words = [[word] for word in (*grammar.words, *[nest] * (len(grammar.words) // 4))]
    for _ in times(rng):
        if parts:
            changed(parts, words, rng, longest=16)
    return "".join(parts).encode("utf-8", "surrogateescape")[:MOST_BYTES]


# ---- arrays ------------------------------------------------------------------------------------------------


def of_arrays(arrays: dict[str, np.ndarray], rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return arrays of which one or two have odd numbers, another shape or type, or are missing."""
    found = dict(arrays)
    for _ in range(rng.integers(1, 3)):
        name = str(rng.choice(list(found)))
        if rng.random() < 0.05 and len(found) > 1:
            del found[name]
        else:
            found[name] = _odd(np.array(found[name]), rng)
    return found


def _odd(array, rng):
    """Return an array with odd numbers, or of another shape or type."""
    match rng.integers(10):
        case 0:
            return array.astype(rng.choice(["f4", "f8", "i8", "u4", "u1", "?"]))
        case 1:
            return array.reshape(-1)[: rng.integers(array.size + 1)]
        case 2:
            return array[None] if rng.random() < 0.5 else array.ravel()
    bits = (0, 1, 2**31 - 1, 2**31, 2**32 - 8, 0x7F800000, 0x7FC00000, 0xFF800000, int(rng.integers(2**32)))
    raw = np.atleast_1d(array).copy()
    words = raw.reshape(-1).view(np.uint32 if raw.nbytes % 4 == 0 else np.uint8)
    for _ in times(rng) if words.size else ():
        words[rng.integers(words.size)] = one_of(bits, rng) % 2 ** (8 * words.itemsize)
    return raw.reshape(array.shape)
