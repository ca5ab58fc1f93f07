"""Damage to files: numbers of the header replaced, bits turned, pieces cut, doubled and moved."""

import zlib

import numpy as np

from . import headers

NUMBERS = (
    0, 1, 2, 3, 7, 8, 127, 128, 255, 256, 4095, 32767, 32768, 65535, 65536, 10**6, 2**27, 2**31 - 1, -1, -2,
)  # fmt: skip
"""What a number of the header becomes; and the ends of its own range."""
TEXTS = (*map(str, NUMBERS), "99999999999999999999", "1e9", "-0", "", "nan", "0x10", str(2**63), "16 ")
"""What a decimal number becomes."""
BYTES = 0, 1, 9, 10, 13, 32, 127, 128, 254, 255
MOST_BYTES = 1 << 20
"""A file does not grow beyond this."""


def one_of(choices, rng: np.random.Generator):
    """Return one of a sequence."""
    return choices[rng.integers(len(choices))]


def few(rng) -> int:
    """Return how many times a file is damaged, from 1 to 3: mostly once, so that much of it still holds."""
    return int(rng.integers(1, 4)) if rng.random() < 0.5 else 1


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
            site = one_of(found, rng)
            if site.size == 0:
                _set_text(raw, site, rng)
                break  # what follows has moved
            _set_number(raw, site, rng)
    else:
        for _ in range(few(rng)):
            kind = rng.integers(10)
            if raw:
                _damage(raw, kind, rng)
    if rng.random() < 0.5:
        for at, length, _ in headers.png_chunks(bytes(raw)):
            end = at + 8 + length
            raw[end : end + 4] = zlib.crc32(raw[at + 4 : end]).to_bytes(4, "big")
    return bytes(raw[:MOST_BYTES])


def _set_number(raw, site, rng):
    bits = 8 * site.size
    choices = [*NUMBERS, 2 ** (bits - 1), 2 ** (bits - 1) - 1, 2**bits - 1, int(rng.integers(0, 2**63))]
    old = int.from_bytes(raw[site.offset : site.offset + site.size], site.order)
    choices += [old + 1, old - 1, 2 * old, old ^ 1 << int(rng.integers(bits))]
    value = one_of(choices, rng) % 2**bits
    raw[site.offset : site.offset + site.size] = value.to_bytes(site.size, site.order)


def _set_text(raw, site, rng):
    end = site.offset
    while end < len(raw) and 48 <= raw[end] <= 57:
        end += 1
    raw[site.offset : end] = one_of(TEXTS, rng).encode()


def _damage(raw, kind, rng):
    """Damage bytes in one of ten ways."""
    size = len(raw)
    if kind >= 6:
        start = int(rng.integers(size))
        stop = min(start + int(2 ** rng.uniform(0, 9)), size)
    match kind:
        case 0:
            raw[rng.integers(size)] ^= 1 << int(rng.integers(8))
        case 1:  # headers are a small part of a file, and the more delicate one
            raw[rng.integers(min(size, 400))] ^= 1 << int(rng.integers(8))
        case 2:
            raw[rng.integers(size)] = BYTES[rng.integers(10)]
        case 3:  # cut the end off
            del raw[rng.integers(size + 1) :]
        case 4:
            at, count = rng.integers(size + 1), int(2 ** rng.integers(0, 10))
            same = bytes([rng.integers(256)]) * count
            raw[at:at] = same if rng.random() < 0.5 else rng.bytes(count)
        case 5:  # stretch a byte
            at = int(rng.integers(min(size, 10 ** int(rng.integers(1, 5)))))
            raw[at:at] = raw[at : at + 1] * int(2 ** rng.uniform(4, 17))
        case 6:
            del raw[start:stop]
        case 7:  # double a piece, up to 128 times
            times = int(2 ** rng.uniform(0, 7))
            raw[start:start] = raw[start:stop] * min(times, MOST_BYTES // (stop - start))
        case 8:
            at = int(rng.integers(size))
            raw[at : at + stop - start] = raw[start:stop]
        case 9:
            raw[start:stop] = bytes(stop - start)
