"""Small pictures of the start page: what is offered, what has none, and that nothing runs."""

import base64
import os
import threading

import mitsuba as mi
import numpy as np

from envedit.cli.paint import thumbnails
from envedit.cli.paint.server import PAGE
from envedit.core import shipped
from envedit.images import images


def made(files, seconds=60):
    told, done = {}, threading.Event()

    def say(message):
        told[message["file"]] = message["picture"]
        if len(told) == len(files):
            done.set()

    thumbnails.Thumbnails(say).make(files)
    assert done.wait(seconds), told
    return told


def test_maps_of_a_folder_have_pictures_and_what_is_none_has_not(tmp_path, here, rng):
    # Modules of the folder are not run by the process that reads its files.
    for name in ("numpy", "mitsuba", "base64"):
        (tmp_path / f"{name}.py").write_text("open('ran', 'w')")
    bright = rng.uniform(0.5, 1, (32, 64, 3)).astype(np.float32)
    bright[:16] *= [100, 1, 1]
    images.write_hdr("sky.hdr", 1000 * bright)
    images.write_exr("render.exr", np.ones((30, 40, 3)), panorama=False)
    (tmp_path / "broken.exr").write_bytes(b"\x76\x2f\x31\x01 and no more")
    files = thumbnails.maps([tmp_path, tmp_path / "maps"])
    assert [file.name for file in files] == ["broken.exr", "render.exr", "sky.hdr"]
    pictures = made([*((file.name, True) for file in files), (str(tmp_path / "render.exr"), False)])
    assert pictures["broken.exr"] is None and pictures["render.exr"] is None
    assert pictures[str(tmp_path / "render.exr")] is not None, "a rendering needs not be 2:1"
    (tmp_path / "sky.png").write_bytes(base64.b64decode(pictures["sky.hdr"]))
    shown, _ = images.read_stored("sky.png")
    assert shown.shape == (thumbnails.WIDTH // 2, thumbnails.WIDTH, 3) and shown.dtype == np.uint8
    assert shown[:50, :, 0].mean() > 230 and shown[70:].mean() < 60, "not exposed by its brightest parts"
    assert not os.path.exists("ran")


def test_of_many_maps_the_last_are_offered(tmp_path):
    for i in range(thumbnails.MOST_MAPS + 2):
        (tmp_path / f"{i:02}.hdr").touch()
        os.utime(tmp_path / f"{i:02}.hdr", (1000 + i, 1000 + i))
    offered = thumbnails.maps([tmp_path])
    assert [offered[0].name, len(offered)] == ["02.hdr", thumbnails.MOST_MAPS]


def test_all_that_is_shipped_has_a_picture():
    names = [f"scene-{name}" for name in shipped.complete_scenes()]
    names += [name.replace("edits/", "edit-") for name in shipped.configurations() if "edits/" in name]
    for name in [*names, "map-sunsky"]:
        height, width, _ = np.array(mi.Bitmap(str(PAGE / f"{name}.jpg"))).shape
        assert min(height, width) >= 80, name
