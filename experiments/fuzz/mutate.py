"""Damage to files: numbers of the header replaced, bits turned, pieces cut, doubled and moved."""

import zlib

import numpy as np

from . import headers

NUMBERS = (
    0,
    1,
    2,
    3,
    7,
    8,
    127,
    128,
    255,
    256,
    4095,
    32767,
    32768,
    65535,
    65536,
    10**6,
    2**27,
    2**31 - 1,
    -1,
    -2,
)
"""What a number of the header becomes; and the ends of its own range."""
MOST_BYTES = 1 << 20
"""A file does not grow beyond this."""


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """Return a damaged copy of a file.

    Half of the copies have one to three numbers of their header replaced (:func:`headers.sites`), the others
    one to three of: bits turned, bytes set, the end cut off, bytes inserted, a byte stretched to thousands, a
    piece removed, doubled, moved onto another, or zeroed. In half of the PNGs the chunks get correct
    checksums again, so that the damage is not found at the door.
    """
    raw = bytearray(data)
    if rng.random() < 0.5 and (found := headers.sites(data)):
        for _ in range(few(rng)):
            site = found[rng.integers(len(found))]
            if site.size == 0:
                _set_text(raw, site, rng)
                break  # what follows has moved
            _set_number(raw, site, rng)
    else:
        for _ in range(few(rng)):
            kind = _GENERIC[rng.integers(len(_GENERIC))]
            if raw:
                kind(raw, rng)
    if rng.random() < 0.5:
        _mend_checksums(raw)
    return bytes(raw[:MOST_BYTES])


def few(rng) -> int:
    """Return how many times a file is damaged, from 1 to 3: mostly once, so that much of it still holds."""
    return int(rng.integers(1, 4)) if rng.random() < 0.5 else 1


def _set_number(raw, site, rng):
    bits = 8 * site.size
    choices = [*NUMBERS, 2 ** (bits - 1), 2 ** (bits - 1) - 1, 2**bits - 1, int(rng.integers(0, 2**63))]
    old = int.from_bytes(raw[site.offset : site.offset + site.size], site.order)
    choices += [old + 1, old - 1, 2 * old, old ^ 1 << int(rng.integers(bits))]
    value = choices[rng.integers(len(choices))] % 2**bits
    raw[site.offset : site.offset + site.size] = value.to_bytes(site.size, site.order)


def _set_text(raw, site, rng):
    end = site.offset
    while end < len(raw) and 48 <= raw[end] <= 57:
        end += 1
    texts = [str(n) for n in NUMBERS] + [
        "99999999999999999999",
        "1e9",
        "-0",
        "",
        "nan",
        "0x10",
        str(2**63),
        "16 ",
    ]
    raw[site.offset : end] = texts[rng.integers(len(texts))].encode()


def _flip(raw, rng):
    raw[rng.integers(len(raw))] ^= 1 << int(rng.integers(8))


def _flip_early(raw, rng):  # headers are a small part of a file, and the more delicate one
    raw[rng.integers(min(len(raw), 400))] ^= 1 << int(rng.integers(8))


def _set(raw, rng):
    raw[rng.integers(len(raw))] = (0, 1, 9, 10, 13, 32, 127, 128, 254, 255)[rng.integers(10)]


def _truncate(raw, rng):
    del raw[rng.integers(len(raw) + 1) :]


def _insert(raw, rng):
    at, count = rng.integers(len(raw) + 1), int(2 ** rng.integers(0, 10))
    same = bytes([rng.integers(256)]) * count
    raw[at:at] = same if rng.random() < 0.5 else rng.bytes(count)


def _stretch(raw, rng):
    at = int(rng.integers(min(len(raw), 10 ** int(rng.integers(1, 5)))))
    raw[at:at] = raw[at : at + 1] * int(2 ** rng.uniform(4, 17))


def _piece(raw, rng):
    start = int(rng.integers(len(raw)))
    return start, min(start + int(2 ** rng.uniform(0, 9)), len(raw))


def _remove(raw, rng):
    start, stop = _piece(raw, rng)
    del raw[start:stop]


def _double(raw, rng):
    start, stop = _piece(raw, rng)
    times = int(2 ** rng.uniform(0, 7))
    raw[start:start] = raw[start:stop] * min(times, MOST_BYTES // (stop - start))


def _copy_over(raw, rng):
    start, stop = _piece(raw, rng)
    at = int(rng.integers(len(raw)))
    raw[at : at + stop - start] = raw[start:stop]


def _zero(raw, rng):
    start, stop = _piece(raw, rng)
    raw[start:stop] = bytes(stop - start)


_GENERIC = (_flip, _flip_early, _set, _truncate, _insert, _stretch, _remove, _double, _copy_over, _zero)


def _mend_checksums(raw):
    for at, length, _ in headers.png_chunks(bytes(raw)):
        end = at + 8 + length
        raw[end : end + 4] = zlib.crc32(raw[at + 4 : end]).to_bytes(4, "big")
