"""Files that a scene names are read by a process of their own before Mitsuba reads them here."""

import os
import re
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


def files():
    """List plugin, content and words of the error, which are empty of a good file; by what is in them."""
    found = {}
    for form in FORMS:
        found |= {
            f"{form}": ("ply", ply(form), ""),
            f"{form}, an index": ("ply", ply(form, (3, 0, 1, 3)), "face 0 names vertex 3 of 3"),
            f"{form}, a large index": ("ply", ply(form, (3, 0, 1, 99_999_999)), "face 0 names vertex"),
            f"{form}, cut": ("ply", ply(form)[:-2], "export it again"),
            f"{form}, 2 faces": ("ply", ply(form, faces=2), "export it again"),
            f"{form}, 4e9 faces": ("ply", ply(form, faces=4_000_000_000), "export it again"),
            f"{form}, 1e17 faces": ("ply", ply(form, faces=10**17), "export it again"),
            f"{form}, a polygon": ("ply", ply(form, (4, 0, 1, 2, 2)), "export it again, as triangles"),
        }
    too_much = "declares more than a file of this size holds"
    found |= {
        "serialized": ("serialized", serialized(), ""),
        "an index": ("serialized", serialized(3), "face 0 names vertex 3 of 3"),
        "a large index": ("serialized", serialized(99_999_999), "face 0 names vertex 99999999 of 3"),
        "no table": ("serialized", serialized(99_999_999, count=0), "face 0 names vertex 99999999 of 3"),
        "1e12 vertices": ("serialized", serialized(vertices=10**12), too_much),
        "1e12 faces": ("serialized", serialized(faces=10**12), too_much),
        "volume": ("gridvolume", volume(), ""),
        "huge": ("gridvolume", volume((30_000, 30_000, 30_000, 1)), too_much),
        "negative": ("gridvolume", volume((-3, 3, 3, 1)), too_much),
        "another type": ("gridvolume", volume(kind=7), "cannot be read as gridvolume"),
        "cut": ("gridvolume", volume(values=7), "cannot be read as gridvolume"),
        "spectrum": ("spectrum", b"# nm value\n400 0.5\n700 5.e-1\n", ""),
        "a secret for obj": ("obj", SECRET, "holds no vertex"),
        "a control character": ("obj", b"v 0 secret\1 0\n", "cannot be read as obj"),
    }
    found |= {f"a secret for {p}": (p, SECRET, "again") for p in scene_files.PLUGINS - {"obj", "bitmap"}}
    return found


def textures(folder):
    """List what :func:`files` does of textures; what is damaged here stops Mitsuba, or its memory is."""
    shades = np.linspace(0, 1, 3600, dtype=np.float32).reshape(40, 30, 3).round(2)
    exr = written(folder / "a.exr", shades)
    # Two chunks of 32 rows: the table holds where the first and the second begin.
    first = min(n for n in range(8, len(exr)) if exr[n - 16 : n - 8] == struct.pack("<Q", n))
    outside = exr[: first - 8] + struct.pack("<Q", 1 << 61) + exr[first:]
    png = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + struct.pack(">2I", 60_000, 60_000) + b"\x08\2\0\0\0" + bytes(4)
    hdr = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 16 +X 16\n\2\2\0\20\xff\1"
    jpeg = written(folder / "a.jpg", np.full((16, 16, 3), 90, np.uint8))
    scan = jpeg.index(b"\xff\xda") + 11  # where its coefficients begin
    return {
        "OpenEXR": ("bitmap", exr, ""),
        "JPEG": ("bitmap", jpeg, ""),
        "a chunk is cut": ("bitmap", exr[:-200], "damaged or truncated"),
        "a chunk is outside": ("bitmap", outside, "table of chunks points out of the file"),
        "huge": ("bitmap", png, "the header declares 60000 x 60000 texels"),
        "a damaged line": ("bitmap", hdr, "damaged or truncated"),
        "damaged coefficients": ("bitmap", jpeg[:scan] + b"\7" + jpeg[scan + 1 :], "damaged or truncated"),
        "a secret": ("bitmap", SECRET, "cannot be read as bitmap"),
    }


def test_damaged_files_are_refused_without_their_text_and_nothing_is_printed(tmp_path, capfd):
    cases = {**files(), **{f"texture, {name}": case for name, case in textures(tmp_path).items()}}
    listed = []
    for i, (plugin, content, _) in enumerate(cases.values()):
        (tmp_path / f"{i}.spd").write_bytes(content)
        listed.append(SceneFile(plugin, str(tmp_path / f"{i}.spd")))
    errors = [str(error) for error in scene_files.errors(listed)]
    for file, (name, (_, _, words)) in zip(listed, cases.items(), strict=True):
        (error,) = [text for text in errors if text.startswith(f"{file.path}: ")] or [""]
        assert words in error and bool(words) == bool(error), (name, error)
        assert len(error.splitlines()) <= 1 and error.isprintable()
        assert not re.search("root|secret", error.replace(str(tmp_path), "")), (name, error)
    assert capfd.readouterr() == ("", "")


def test_a_scene_with_a_damaged_file_is_refused_and_with_a_good_one_loads(tmp_path):
    shape = '<shape type="ply"><string name="filename" value="mesh.ply"/></shape>'
    named = write_scene(tmp_path, SENSOR, LIGHT, shape)
    (tmp_path / "mesh.ply").write_bytes(ply("ascii", (3, 0, 1, 3)))
    with pytest.raises(InputError, match=r"mesh\.ply: face 0 names vertex 3 of 3"):
        scene.load(named)
    (tmp_path / "mesh.ply").write_bytes(ply("ascii"))
    assert scene.load(named).mi.shapes()[0].face_count() == 1


def test_a_spectrum_is_read_before_the_scene(tmp_path):
    part = '<bsdf type="diffuse"><spectrum name="reflectance" filename="secret.spd"/></bsdf>'
    named = write_scene(tmp_path, SENSOR, LIGHT, f'<shape type="sphere">{part}</shape>')
    (tmp_path / "secret.spd").write_bytes(SECRET)
    with pytest.raises(InputError, match=r"secret\.spd: cannot be read as spectrum.*again, as NAME\.spd$"):
        scene.load(named)


def test_a_sparse_file_of_5_gb_and_a_pipe_are_not_read(tmp_path):
    path = tmp_path / "mesh.ply"
    path.write_bytes(ply("ascii"))
    os.truncate(path, 5 << 30)
    with pytest.raises(InputError, match="5368709120 bytes, expected at most 4294967296"):
        scene_files.errors([SceneFile("ply", str(path))])
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="is no regular file"):
        scene_files.errors([SceneFile("obj", str(tmp_path / "pipe"))])


# ---- the other process -------------------------------------------------------------------------------------
def stand_in(folder, monkeypatch, script):
    """Put a script in place of Python in the other process."""
    (folder / "python").write_text(f"#!/bin/sh\n{script}\n")
    (folder / "python").chmod(0o700)
    monkeypatch.setattr(sys, "executable", str(folder / "python"))


@pytest.mark.slow
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
