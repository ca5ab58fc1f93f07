"""Meshes, textures, volumes, curves and spectra are checked before Mitsuba reads them."""

import os
import struct
import zlib

import mitsuba as mi
import numpy as np
import pytest

from envedit.core.errors import InputError
from envedit.scene import scene, scene_files
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


def ply(path, face, form="ascii", faces=1, kind="int"):
    head = HEADER.format(form=form, faces=faces, kind=kind)
    if form == "ascii":
        path.write_text(head + "0 0 0\n1 0 0\n0 1 0\n" + " ".join(map(str, face)) + "\n")
    else:
        order = "<" if "little" in form else ">"
        indices = np.array(face[1:], np.int64).astype(f"{order}u4").tobytes()
        path.write_bytes(head.encode() + POINTS.astype(f"{order}f4").tobytes() + bytes([face[0]]) + indices)
    return path


def serialized(path, index=2, vertices=3, faces=1, flags=0x1000, count=1, offset=0):
    body = struct.pack("<I", flags) + b"x\0" + struct.pack("<QQ", vertices, faces)
    body += POINTS.tobytes() + np.array([0, 1, index], "<u4").tobytes()
    path.write_bytes(struct.pack("<HH", 0x041C, 4) + zlib.compress(body) + struct.pack("<QI", offset, count))
    return path


def volume(path, shape=(2, 2, 2, 1), kind=1, values=8):
    head = b"VOL\3" + struct.pack("<5i", kind, *shape) + struct.pack("<6f", 0, 0, 0, 1, 1, 1)
    path.write_bytes(head + bytes(4 * values))
    return path


FORMS = ("ascii", "binary_little_endian", "binary_big_endian")


@pytest.mark.parametrize("form", FORMS)
def test_a_ply_with_an_index_out_of_range_is_refused_and_a_good_one_loads(tmp_path, form):
    path = tmp_path / "mesh.ply"
    file = f'<shape type="ply"><string name="filename" value="{path.name}"/></shape>'
    named = write_scene(tmp_path, SENSOR, LIGHT, file)
    for bad in (3, 99_999_999, -1):
        ply(path, (3, 0, 1, bad), form)
        with pytest.raises(InputError, match=rf"mesh\.ply: face 0 names vertex {bad} of 3"):
            scene.load(named)
    ply(path, (3, 0, 1, 2), form)
    assert scene.load(named).mi.shapes()[0].face_count() == 1


@pytest.mark.parametrize("form", FORMS[:2])
def test_a_ply_that_is_cut_or_declares_too_much_is_refused(tmp_path, form):
    path = ply(tmp_path / "mesh.ply", (3, 0, 1, 2), form)
    os.truncate(path, path.stat().st_size - (2 if form == "ascii" else 1))
    with pytest.raises(InputError, match=r"the file ends before its 1 face elements"):
        scene_files.check("ply", str(path))
    for faces in (4_000_000_000, 10**17):
        with pytest.raises(InputError, match="the header declares"):
            scene_files.check("ply", str(ply(path, (3, 0, 1, 2), form, faces)))
    with pytest.raises(InputError, match="polygons that are no triangles"):
        scene_files.check("ply", str(ply(path, (4, 0, 1, 2, 2), form)))
    with pytest.raises(InputError, match="a line of the PLY header"):
        scene_files.check("ply", str(ply(path, (3, 0, 1, 2), form, kind="root:x:0:0")))
    if form == "ascii":
        with pytest.raises(InputError, match="no whole number"):
            scene_files.check("ply", str(ply(path, (3, 0, 1, "2x"), form)))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"index": 99_999_999}, "face 0 names vertex 99999999 of 3"),
        ({"index": 99_999_999, "count": 0}, "face 0 names vertex 99999999 of 3"),
        ({"vertices": 10**12}, "the file ends before"),
        ({"faces": 10**12}, "the file ends before"),
        ({"count": 10**9}, "1000000000 meshes are declared"),
        ({"offset": 10**9}, "begins after the end"),
        ({"offset": 3}, "damaged or truncated"),
    ],
)
def test_a_serialized_mesh_is_walked_through(tmp_path, changes, says):
    """Also the first mesh of a table that is empty."""
    path = serialized(tmp_path / "a.serialized")
    scene_files.check("serialized", str(path))
    assert mi.load_dict({"type": "serialized", "filename": str(path)}).face_count() == 1
    with pytest.raises(InputError, match=says):
        scene_files.check("serialized", str(serialized(path, **changes)))


@pytest.mark.parametrize(
    "changes", [{"shape": (30_000, 30_000, 30_000, 1)}, {"shape": (-3, 3, 3, 1)}, {"kind": 7}, {"values": 7}]
)
def test_a_volume_holds_what_it_declares(tmp_path, changes):
    scene_files.check("gridvolume", str(volume(tmp_path / "a.vol")))
    with pytest.raises(InputError, match="the header declares"):
        scene_files.check("gridvolume", str(volume(tmp_path / "a.vol", **changes)))


@pytest.mark.parametrize("plugin", ["ply", "obj", "serialized", "gridvolume", "bsplinecurve", "linearcurve"])
def test_a_file_that_is_something_else_is_not_repeated(tmp_path, plugin):
    (tmp_path / "secret").write_text("root:x:0:0:root:/root:/bin/bash\n" * 3)
    shape = f'<shape type="{plugin}"><string name="filename" value="secret"/></shape>'
    if plugin == "gridvolume":
        shape = (
            '<shape type="sphere"><medium type="heterogeneous" name="interior"><volume type="gridvolume" '
            'name="sigma_t"><string name="filename" value="secret"/></volume></medium></shape>'
        )
    with pytest.raises(InputError) as caught:
        scene.load(write_scene(tmp_path, SENSOR, LIGHT, shape))
    assert "root" not in str(caught.value).replace(str(tmp_path), "")


def test_a_spectrum_file_that_is_something_else_is_not_repeated(tmp_path):
    (tmp_path / "secret").write_text("root:x:0:0:root:/root:/bin/bash\n")
    part = '<bsdf type="diffuse"><spectrum name="reflectance" filename="secret"/></bsdf>'
    with pytest.raises(InputError, match="secret, line 1: expected numbers") as caught:
        scene.load(write_scene(tmp_path, SENSOR, LIGHT, f'<shape type="sphere">{part}</shape>'))
    assert "root:" not in str(caught.value)
    (tmp_path / "secret").write_text("# nm value\n400 0.5\n700, 5.e-1\n")
    scene_files.check_numbers(tmp_path / "secret")


def test_a_sparse_file_of_5_gb_and_a_pipe_are_not_read(tmp_path):
    path = ply(tmp_path / "mesh.ply", (3, 0, 1, 2))
    os.truncate(path, 5 << 30)
    with pytest.raises(InputError, match="5368709120 bytes, expected at most 2147483648"):
        scene_files.check("ply", str(path))
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="is no regular file"):
        scene_files.check("obj", str(tmp_path / "pipe"))


def test_textures_state_sizes_that_can_be_read(tmp_path):
    png = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + struct.pack(">2I", 60_000, 60_000) + b"\x08\2\0\0\0" + bytes(4)
    (tmp_path / "a.png").write_bytes(png)
    with pytest.raises(InputError, match="the header declares 60000 x 60000 texels"):
        scene_files.check("bitmap", str(tmp_path / "a.png"))
    (tmp_path / "a.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 16 +X 16\n\2\2\0\20\xff\1")
    with pytest.raises(InputError, match="damaged or truncated"):
        scene_files.check("bitmap", str(tmp_path / "a.hdr"))
    mi.Bitmap(np.ones((4, 4, 3), np.float32)).write(str(tmp_path / "a.exr"))
    scene_files.check("bitmap", str(tmp_path / "a.exr"))


def test_textures_that_mitsubas_decoder_does_not_survive_are_refused(tmp_path):
    """A chunk that is cut, and a table of chunks that points out of the file, stop the process."""
    path = tmp_path / "a.exr"
    mi.Bitmap(np.linspace(0, 1, 3600, dtype=np.float32).reshape(40, 30, 3).round(2)).write(str(path))
    scene_files.check("bitmap", str(path))
    whole = path.read_bytes()
    path.write_bytes(whole[:-200])
    with pytest.raises(InputError, match="damaged or truncated"):
        scene_files.check("bitmap", str(path))
    # Two chunks of 32 rows: the table holds where the first and the second begin.
    first = min(n for n in range(8, len(whole)) if whole[n - 16 : n - 8] == struct.pack("<Q", n))
    path.write_bytes(whole[: first - 8] + struct.pack("<Q", 1 << 61) + whole[first:])
    with pytest.raises(InputError, match="table of chunks points out of the file"):
        scene_files.check("bitmap", str(path))


def test_a_damaged_jpeg_is_refused_and_nothing_is_printed(tmp_path, capfd):
    path = tmp_path / "a.jpg"
    mi.Bitmap(np.full((16, 16, 3), 90, np.uint8)).write(str(path))
    scene_files.check("bitmap", str(path))
    whole = path.read_bytes()
    scan = whole.index(b"\xff\xda")
    path.write_bytes(whole[: scan + 11] + b"\7" + whole[scan + 12 :])  # where its coefficients begin
    with pytest.raises(InputError, match="damaged or truncated"):
        scene_files.check("bitmap", str(path))
    assert capfd.readouterr() == ("", "")


def test_a_line_of_an_obj_that_cannot_be_read_is_not_repeated(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 secret\1 0\n")
    shape = '<shape type="obj"><string name="filename" value="a.obj"/></shape>'
    with pytest.raises(InputError, match="could not parse line$") as caught:
        scene.load(write_scene(tmp_path, SENSOR, LIGHT, shape))
    assert str(caught.value).isprintable()
