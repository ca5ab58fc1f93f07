"""Weight files: every precision of both formats, what is missing, and files damaged on purpose."""

import pickle
import struct
import zipfile

import numpy as np
import pytest

from envedit.core.errors import InputError
from envedit.losses.perceptual import weights
from tests.oracles.weight_files import write_safetensors

WANTED = {"a.weight": (2, 3, 1, 1), "a.bias": (2,)}


def values():
    rng = np.random.default_rng(5)
    # Multiples of 1/8: exact in every format.
    return {name: (rng.integers(-64, 64, shape) / 8).astype(np.float32) for name, shape in WANTED.items()}


def load(path):
    return weights.read(path, WANTED, "the test", "a test's folder")


def refused(path, *words):
    with pytest.raises(InputError) as info:
        load(path)
    message = str(info.value)
    assert str(path) in message and len(message.splitlines()) <= 2 and len(message) < 600
    for word in words:
        assert word in message
    return message


@pytest.mark.parametrize("kind", ["F16", "F32", "F64", "BF16"])
def test_safetensors_of_every_precision(tmp_path, kind):
    found = load(write_safetensors(tmp_path / "w.safetensors", values(), kind))
    for name, expected in values().items():
        assert found[name].dtype == np.float32
        np.testing.assert_array_equal(found[name], expected)


@pytest.mark.parametrize("kind", ["<f2", ">f4", "<f8"])
@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_npz_of_every_precision_and_order(tmp_path, kind, save):
    save(tmp_path / "w.npz", **{k: np.asfortranarray(v.astype(kind)) for k, v in values().items()}, more=1)
    for name, found in load(tmp_path / "w.npz").items():
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found, values()[name])


def test_bfloat16_keeps_its_range(tmp_path):
    large = values() | {"a.bias": np.array([2.0**100, -(2.0**-100)], np.float32)}
    found = load(write_safetensors(tmp_path / "w", large, "BF16"))
    np.testing.assert_array_equal(found["a.bias"], large["a.bias"])


def test_what_is_missing_is_told(tmp_path):
    refused(tmp_path / "none.npz", "no such file", "the test: a test's folder")
    refused(tmp_path, "no such file")
    np.savez(tmp_path / "w.npz", **{"a.weight": values()["a.weight"]})
    refused(tmp_path / "w.npz", "no 'a.bias'", "a test's folder")
    path = write_safetensors(tmp_path / "w.safetensors", {"b": [1.0]})
    refused(path, "no 'a.weight' and 1 more of 2 tensors")


def test_other_shapes_types_and_values_are_refused(tmp_path):
    good, path, archive = values(), tmp_path / "w.safetensors", tmp_path / "w.npz"
    other = good | {"a.bias": np.zeros(3, np.float32)}
    broken = good | {"a.weight": np.where(good["a.weight"] < 0, np.nan, 1).astype(np.float32)}
    for case, words in ((other, "(3,), in the test it is (2,)"), (broken, "'a.weight' holds nan at (0,")):
        np.savez(archive, **case)
        refused(archive, words)
        refused(write_safetensors(path, case), words)
    refused(write_safetensors(path, good, "I64"), "'a.weight' has the type I64; save it as float32")
    np.savez(archive, **{k: v.astype(np.int32) for k, v in good.items()})
    refused(archive, "has the type int32")
    np.savez(archive, **(good | {"a.bias": np.array([1e300, 0])}))
    refused(archive, "'a.bias' holds inf at (0,)")
    signalling = np.array([0x7FF0000000000001, 0], np.uint64).view(np.float64)
    np.savez(archive, **(good | {"a.bias": signalling}))
    refused(archive, "'a.bias' holds nan at (0,)")


def test_pytorch_files_are_not_unpickled(tmp_path):
    class Trap:
        def __reduce__(self):
            return pytest.fail, ("a pickle was loaded",)

    path = tmp_path / "old.pth"
    path.write_bytes(pickle.dumps({"a": Trap()}))
    refused(path, "PyTorch", "np.savez", "torch.load('old.pth'")
    with zipfile.ZipFile(tmp_path / "new.pth", "w") as archive:
        archive.writestr("new/data.pkl", b"")
    refused(tmp_path / "new.pth", "PyTorch", "np.savez")
    np.savez(tmp_path / "w.npz", **(values() | {"a.bias": np.array([Trap(), Trap()], object)}))
    refused(tmp_path / "w.npz", "'a.bias' has the type object")


def test_every_truncation_is_refused(tmp_path):
    np.savez(tmp_path / "w.npz", **values())
    write_safetensors(tmp_path / "w.safetensors", values())
    for name in ("w.npz", "w.safetensors"):
        whole = (tmp_path / name).read_bytes()
        for size in range(0, len(whole), 7):
            (tmp_path / "short").write_bytes(whole[:size])
            refused(tmp_path / "short")


def test_hostile_safetensors_are_refused(tmp_path):
    path, good = tmp_path / "w.safetensors", values()

    def entry(**changes):
        return lambda entries: entries["a.bias"].update(changes)

    for changes in (
        {"data_offsets": [0, 2**62]},
        {"data_offsets": [-8, 0]},
        {"data_offsets": [0.0, 8.0]},
        {"data_offsets": [False, 8]},
        {"data_offsets": [0]},
        {"data_offsets": "08"},
        {"shape": "2"},
        {"shape": [-2]},
        {"shape": None},
    ):
        path = write_safetensors(path, good, change=entry(**changes))
        refused(path, "damaged", "the entry of 'a.bias' in its header")
    for place in ([24, 2**40], [8, 0], [24, 33]):
        refused(write_safetensors(path, good, change=entry(data_offsets=place)), "'a.bias' lies at bytes")
    for place in ([28, 36], [2**40, 2**40 + 8]):
        refused(write_safetensors(path, good, change=entry(data_offsets=place)), "bytes too early")
    for kind in (None, [], {}, "F4096" * 1000):
        refused(write_safetensors(path, good, change=entry(dtype=kind)), "'a.bias' has the type")
    refused(write_safetensors(path, good, change=lambda e: e.update({"a.bias": 5})), "damaged")
    bias = b'"a.bias": {"dtype": "F32", "shape": [2], "data_offsets": [24, 32]}'
    weight = b'"a.weight": {"dtype": "F32", "shape": [2, 3, 1, 1], "data_offsets": [0, 24]}'
    load(write_safetensors(path, good, header=b"{" + bias + b", " + weight + b"}"))
    repeated = b"{" + bias + b", " + weight + b", " + bias + b"}"
    refused(write_safetensors(path, good, header=repeated), "a name occurs twice")
    for header in (b"{" * 100_000, b"{\xff}", b"{}", b'{"a":' * 50_000, b"{}" + b" " * 100):
        refused(write_safetensors(path, good, header=header))
    for length in (2**63, 2**64 - 1, 2**24 + 1, 400):
        path.write_bytes(struct.pack("<Q", length) + b"{}" + b"\0" * 100)
        refused(path, "damaged")


def test_too_little_memory_is_told(tmp_path, monkeypatch):
    def read(*_):
        raise MemoryError

    np.savez(tmp_path / "w.npz", **values())
    monkeypatch.setattr(weights, "_read_npz", read)
    refused(tmp_path / "w.npz", "not enough memory to read the weights of the test")


def test_hostile_archives_are_refused(tmp_path):
    path, good = tmp_path / "w.npz", values()

    def archive(member):
        np.savez(path, **{"a.weight": good["a.weight"]})
        with zipfile.ZipFile(path, "a") as file:
            file.writestr("a.bias.npy", member)
        return path

    def header(shape, kind="'<f4'"):
        text = f"{{'descr': {kind}, 'fortran_order': False, 'shape': {shape}}}".encode()
        return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text

    refused(archive(header("(1000000000000,)")), "in the test it is (2,)")  # declared, never allocated
    refused(archive(header("(2,)")), "damaged")
    refused(archive(header("(2,)", "'|V1000000'")), "has the type")
    refused(archive(b"\x93NUMPY\x07\x00" + b"0" * 100), "damaged")
    refused(archive(b"no array"), "damaged")
    refused(archive(b""), "damaged")
    long = archive(header(f"({'1, ' * 3000})"))
    refused(long, "in the test it is (2,)")
    with zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA) as file:  # it asks for a dictionary of up to 4 GB
        for tensor, array in good.items():
            with file.open(f"{tensor}.npy", "w") as member:
                np.save(member, array)
    refused(path, "damaged", "compressed in a way that numpy does not use")
    path.write_bytes(b"PK\x03\x04" + b"\0" * 100)
    refused(path, "damaged")
    path.write_bytes(b"GIF89a" + b"\0" * 100)
    refused(path, "neither safetensors nor npz")
