"""Files that a scene names are read by a process of their own before Mitsuba reads them here."""

import os
import struct
import subprocess
import sys
import zlib

import mitsuba as mi
import numpy as np
import pytest

from envedit.core.errors import InputError, MachineError
from envedit.scene import scene, scene_files
from envedit.scene.scene_files import SceneFile
from tests.oracles.builders import LIGHT, SENSOR, write_scene

HEADER = """ply
format {form} 1.0
comment a triangle
element vertex 3
property float x
property float y
property float z
element face {faces}
property list uchar {kind} vertex_indices
end_header
"""
POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4")
FORMS = ("ascii", "binary_little_endian", "binary_big_endian")
SECRET = b"root:x:0:0:root:/root:/bin/bash\n" * 3
BALL = '<shape type="sphere">{}</shape>'


def ply(form, face=(3, 0, 1, 2), faces=1, kind="int"):
    head = HEADER.format(form=form, faces=faces, kind=kind).encode()
    if form == "ascii":
        return head + b"0 0 0\n1 0 0\n0 1 0\n" + " ".join(map(str, face)).encode() + b"\n"
    order = "<" if "little" in form else ">"
    indices = np.array(face[1:], np.int64).astype(f"{order}u4").tobytes()
    return head + POINTS.astype(f"{order}f4").tobytes() + bytes([face[0]]) + indices


def serialized(index=2, vertices=3, faces=1, count=1):
    body = struct.pack("<I", 0x1000) + b"x\0" + struct.pack("<QQ", vertices, faces)
    body += POINTS.tobytes() + np.array([0, 1, index], "<u4").tobytes()
    return struct.pack("<HH", 0x041C, 4) + zlib.compress(body) + struct.pack("<QI", 0, count)


def volume(shape=(2, 2, 2, 1), kind=1, values=8):
    return b"VOL\3" + struct.pack("<5i6f", kind, *shape, 0, 0, 0, 1, 1, 1) + bytes(4 * values)


def wrong(folder, plugin, *contents):
    """Return what is wrong with files of these contents: their errors in turn, "" of a good one."""
    files = [SceneFile(plugin, str(folder / f"{i}.file")) for i in range(len(contents))]
    for file, data in zip(files, contents, strict=True):
        with open(file.path, "wb") as opened:
            opened.write(data)
    found = [str(error) for error in scene_files.errors(files)]
    assert len({*found}) == len(found) and all(len(text.splitlines()) == 1 for text in found)
    return ["".join(text for text in found if text.startswith(f"{file.path}: ")) for file in files]


def written(path, array):
    mi.Bitmap(array).write(str(path))
    return path.read_bytes()


def test_a_ply_with_an_index_out_of_range_is_refused_and_a_good_one_loads(tmp_path):
    found = wrong(tmp_path, "ply", *(ply(form, (3, 0, 1, index)) for index in (2, 3) for form in FORMS))
    assert found[:3] == [""] * 3 and all("face 0 names vertex 3 of 3" in text for text in found[3:])
    shape = '<shape type="ply"><string name="filename" value="{}.file"/></shape>'
    assert scene.load(write_scene(tmp_path, SENSOR, LIGHT, shape.format(0))).mi.shapes()[0].face_count() == 1
    with pytest.raises(InputError, match="face 0 names vertex 3"):
        scene.load(write_scene(tmp_path, SENSOR, LIGHT, shape.format(3)))


def test_a_ply_that_is_cut_or_declares_too_much_is_refused(tmp_path):
    bad = []
    for form in FORMS:
        bad += [ply(form)[:-2], *(ply(form, faces=faces) for faces in (2, 4_000_000_000, 10**17))]
        bad += [ply(form, (4, 0, 1, 2, 2)), ply(form, (3, 0, 1, 99_999_999))]  # no triangle; far beyond
    assert all(wrong(tmp_path, "ply", *bad))


def test_a_serialized_mesh_is_walked_through(tmp_path):
    bad = [serialized(3), serialized(99_999_999), serialized(99_999_999, count=0)]
    bad += [serialized(vertices=10**12), serialized(faces=10**12)]
    good, *found = wrong(tmp_path, "serialized", serialized(), *bad)
    assert not good and all(found) and "face 0 names vertex 99999999 of 3" in found[2]


def test_a_volume_holds_what_it_declares(tmp_path):
    bad = [{"shape": (30_000, 30_000, 30_000, 1)}, {"shape": (-3, 3, 3, 1)}, {"kind": 7}, {"values": 7}]
    good, *found = wrong(tmp_path, "gridvolume", volume(), *(volume(**changes) for changes in bad))
    assert not good and all(found) and "declares more than a file of this size holds" in found[0]


def test_a_file_that_is_something_else_is_not_repeated(tmp_path):
    (tmp_path / "secret").write_bytes(SECRET)
    plugins = sorted(scene_files.PLUGINS)
    found = scene_files.errors([SceneFile(plugin, str(tmp_path / "secret")) for plugin in plugins])
    assert len(found) == len(plugins) and not any("root:" in str(error) for error in found)


def test_a_spectrum_file_that_is_something_else_is_not_repeated(tmp_path):
    part = '<bsdf type="diffuse"><spectrum name="reflectance" filename="secret.spd"/></bsdf>'
    named = write_scene(tmp_path, '<path value="."/>', SENSOR, LIGHT, BALL.format(part))
    (tmp_path / "secret.spd").write_bytes(SECRET)
    with pytest.raises(InputError, match=r"secret\.spd: cannot be read as spectrum") as caught:
        scene.load(named)
    assert "root:" not in str(caught.value)
    (tmp_path / "secret.spd").write_text("# nm value\n400 0.5\n700 5.e-1\n")
    scene.load(named)


def test_a_line_of_an_obj_that_cannot_be_read_is_not_repeated(tmp_path):
    assert "secret" not in wrong(tmp_path, "obj", b"v 0 secret\1 0\n")[0].replace(str(tmp_path), "")


def test_a_sparse_file_of_5_gb_and_a_pipe_are_not_read(tmp_path):
    path = tmp_path / "mesh.ply"
    path.write_bytes(ply("ascii"))
    os.truncate(path, 5 << 30)
    with pytest.raises(InputError, match="5368709120 bytes, expected at most 4294967296"):
        scene_files.errors([SceneFile("ply", str(path))])
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="is no regular file"):
        scene_files.errors([SceneFile("obj", str(tmp_path / "pipe"))])


def test_textures_state_sizes_that_can_be_read(tmp_path):
    png = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + struct.pack(">2I", 60_000, 60_000) + b"\x08\2\0\0\0" + bytes(4)
    hdr = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 16 +X 16\n\2\2\0\20\xff\1"
    exr = written(tmp_path / "a.exr", np.ones((4, 4, 3), np.float32))
    good, huge, damaged = wrong(tmp_path, "bitmap", exr, png, hdr)
    assert not good and "the header declares 60000 x 60000 texels" in huge
    assert "damaged or truncated" in damaged


def test_textures_that_mitsubas_decoder_does_not_survive_are_refused(tmp_path):
    """A chunk that is cut, and a table of chunks that points out of the file, stop the process."""
    shades = np.linspace(0, 1, 3600, dtype=np.float32).reshape(40, 30, 3).round(2)
    whole = written(tmp_path / "a.exr", shades)
    # Two chunks of 32 rows: the table holds where the first and the second begin.
    first = min(n for n in range(8, len(whole)) if whole[n - 16 : n - 8] == struct.pack("<Q", n))
    outside = whole[: first - 8] + struct.pack("<Q", 1 << 61) + whole[first:]
    good, cut, far = wrong(tmp_path, "bitmap", whole, whole[:-200], outside)
    assert not good and "damaged or truncated" in cut and "table of chunks points out of the file" in far


def test_a_damaged_jpeg_is_refused_and_nothing_is_printed(tmp_path, capfd):
    whole = written(tmp_path / "a.jpg", np.full((16, 16, 3), 90, np.uint8))
    scan = whole.index(b"\xff\xda")
    damaged = whole[: scan + 11] + b"\7" + whole[scan + 12 :]  # where its coefficients begin
    good, bad = wrong(tmp_path, "bitmap", whole, damaged)
    assert not good and "damaged or truncated" in bad and capfd.readouterr() == ("", "")


# ---- the other process -------------------------------------------------------------------------------------


def stand_in(folder, monkeypatch, script):
    """Put a script in place of Python in the other process."""
    (folder / "python").write_text(f"#!/bin/sh\n{script}\n")
    (folder / "python").chmod(0o700)
    monkeypatch.setattr(sys, "executable", str(folder / "python"))


@pytest.mark.usefixtures("own_cache")
def test_what_is_known_to_be_good_is_not_read_again(tmp_path, monkeypatch):
    python = sys.executable
    contents = [ply("ascii", (3, 2, 1, 0)), ply("ascii", (3, 0, 1, 7))]
    good, bad = wrong(tmp_path, "ply", *contents)
    assert not good and bad
    stand_in(tmp_path, monkeypatch, "exit 1")
    assert wrong(tmp_path, "ply", contents[0]) == [""]
    with pytest.raises(MachineError, match="python: the process that reads files of a scene does not start"):
        wrong(tmp_path, "ply", *contents)  # damaged ones are not remembered
    # A new process finds it in the folder of caches.
    code = f"""import sys
sys.path[:], sys.executable = {sys.path!r}, "/nowhere"
from envedit.scene.scene_files import SceneFile, errors
assert errors([SceneFile("ply", {str(tmp_path / "0.file")!r})]) == []"""
    subprocess.run([python, "-c", code], check=True)


@pytest.mark.parametrize("end", ["kill -SEGV $$", "exec sleep 600"])
def test_a_file_that_ends_or_holds_up_the_process_is_named(tmp_path, monkeypatch, end):
    monkeypatch.setattr(scene_files, "SECONDS", 2)  # 8 on the clock
    first = f"mkdir {tmp_path}/begun && {end}"
    stand_in(tmp_path, monkeypatch, f"echo '\"begun\"'; echo '\"is bad\"'; {first}")
    bad, culprit, last = wrong(tmp_path, "ply", *(ply("ascii", (3, 1, 2, i)) for i in range(3)))
    assert bad.endswith("is bad") and last.endswith("is bad")  # the last one in a second process
    assert "Mitsuba stops as it reads this file, or takes over" in culprit
