"""A painting that is served to a test: a small scene, in a thread of its own."""

import asyncio
import contextlib
import json
import threading
import time
import urllib.error
import urllib.request
from unittest import mock

import pytest

SMALL = """
seed = 3
[input]
envmap = "sunsky"
width = 64
[scene]
file = "sphere"
width = 48
[target]
spp = 16
[renderer]
spp = 16
max_depth = 3
[output]
spp = 16
report = false
"""

PHOTO = SMALL.replace(
    "[target]", '[target]\nkind = "photo"\nfile = "photo.png"\ncurve = "srgb"\nalign = false'
)
PHOTO = PHOTO.replace("width = 48", "width = 24")
PHOTO += "[representation]\nturn = false\n[optimizer]\niterations = 1\n"
"""A photograph ``photo.png`` of the scene of :data:`SMALL`, for :func:`photographed`."""


def photographed(folder, azimuth=150):
    """Write :data:`PHOTO`, with the photograph under another sun, to a folder; returns the configuration."""
    import numpy as np

    import envedit
    from envedit.images import images
    from envedit.targets.photo import Camera

    true = envedit.load_scene("sphere", width=24).render(
        envedit.sunsky(64, azimuth=azimuth, elevation=30), spp=64
    )
    images.write_png(folder / "photo.png", Camera("srgb", np.log([1.5, 1.2, 0.8])).shown(true))
    (folder / "edit.toml").write_text(PHOTO)
    return folder / "edit.toml"


_CAMERA = """<sensor type="perspective" id="{name}"><float name="fov" value="30"/>
<transform name="to_world"><lookat origin="0,1,{z}" target="0,0,0" up="0,1,0"/></transform>
<film type="hdrfilm"><integer name="width" value="32"/>
<integer name="height" value="{height}"/></film></sensor>"""
BALL = '<shape type="sphere"><bsdf type="roughplastic"><float name="alpha" value="0.2"/></bsdf></shape>'
TWO_VIEWS = (
    _CAMERA.format(name="front", z=5, height=20),
    _CAMERA.format(name="behind", z=-4, height=28),
    BALL,
)
"""Parts of a scene with two sensors, for :func:`.builders.write_scene`."""
OF_TWO = SMALL.replace('file = "sphere"\nwidth = 48', 'file = "scene.xml"\nwidth = 32\nsensors = "all"')


@contextlib.contextmanager
def served(name, **more):
    """Serve a configuration until the block ends, with few samples of what is shown; yields the server."""
    for module in ("starlette", "websockets"):
        pytest.importorskip(module, reason="the extra envedit[paint] is not installed")
    uvicorn = pytest.importorskip("uvicorn", reason="the extra envedit[paint] is not installed")
    from envedit.cli.paint import project, session, settings
    from envedit.cli.paint.server import Server

    server = Server(None if name is None else project.opened(str(name)), **more)
    running = uvicorn.Server(settings(server, uvicorn))
    thread = threading.Thread(target=lambda: asyncio.run(running.serve([server.socket])), daemon=True)
    thread.start()
    until(lambda: running.started)
    try:
        with mock.patch.object(session, "PASSES", session.FIRST_PASSES + 1):
            yield server
    finally:
        running.should_exit = True
        thread.join(60)
        server.worker.stop()
        server.worker.join(120)
        server.socket.close()
        assert not thread.is_alive() and not server.worker.is_alive()
        assert not server.worker.faults, server.worker.faults


def until(true, seconds=120):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, f"not within {seconds} s"
        time.sleep(0.02)


def connected(server, **more):
    origin = more.pop("origin", server.origins[0])
    from websockets.sync import client

    return client.connect(server.url.replace("http", "ws") + "ws", origin=origin, max_size=None, **more)


def heard(socket, kind, wanted=lambda message: True):
    while True:
        received = socket.recv(timeout=60)
        if isinstance(received, str):
            message = json.loads(received)
            if message["type"] == kind and wanted(message):
                return message


def send(socket, kind, **message):
    socket.send(json.dumps({"type": kind} | message))


def painted(socket, number, document, **more):
    """Send a painting, and return the first status that is of it."""
    send(socket, "document", number=number, document=document, **more)
    return heard(socket, "status", lambda message: message.get("number") == number)


def asked(address, **more):
    try:
        with urllib.request.urlopen(urllib.request.Request(address, **more), timeout=30) as answer:
            return answer.status, answer.read().decode("utf-8", "replace")
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()
