"""Weight files written by hand."""

import json
import struct

import numpy as np

KINDS_OF_NUMBERS = {"F16": "<f2", "F32": "<f4", "F64": "<f8"}


def write_safetensors(path, tensors, kind="F32", change=None, header=None):
    """Write the format by hand; ``change`` edits the header, ``header`` replaces its bytes."""
    entries, data = {"__metadata__": {"format": "pt"}}, b""
    for name, values in tensors.items():
        if kind == "BF16":
            raw = (np.asarray(values, "<f4").view("<u4") >> 16).astype("<u2").tobytes()
        else:
            raw = np.asarray(values, KINDS_OF_NUMBERS.get(kind, "<i8")).tobytes()
        place = [len(data), len(data) + len(raw)]
        entries[name] = {"dtype": kind, "shape": list(np.shape(values)), "data_offsets": place}
        data += raw
    if change:
        change(entries)
    text = json.dumps(entries).encode() if header is None else header
    path.write_bytes(struct.pack("<Q", len(text)) + text + data)
    return path
