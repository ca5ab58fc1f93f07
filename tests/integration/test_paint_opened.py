"""``envedit paint`` opens scenes: of several views, and from the start page.

Not in the module of a server that is shared: one thread of a process may use Dr.Jit.
"""

import json
import os
import struct
from pathlib import Path

import numpy as np
import pytest

from envedit import config, pipeline
from envedit.cli.paint import protocol
from envedit.images import images
from envedit.maps import look_transfer, looks
from envedit.targets.pixel_weights import FOLLOWING
from tests.oracles.builders import LIGHT, write_scene
from tests.oracles.painting import OF_TWO, SMALL, TWO_VIEWS, asked, connected, heard, painted, send, served

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("own_core")]


def sizes_shown(server, views=1):
    """Return width and height of the renderings by T (0) and by Mitsuba (1) of each view."""
    sizes = {}
    with connected(server) as page:
        while {(source, v) for source in (0, 1) for v in range(views)} - set(sizes):
            received = page.recv(timeout=60)
            if isinstance(received, bytes) and received[4] == 0:
                width, height, _, view = struct.unpack("<HHIH", received[6:16])
                sizes[received[5], view] = width, height
    return sizes


@pytest.mark.parametrize(("units", "shown"), [("fraction", (32, 64)), ("pixels", (48, 96))])
def test_a_large_picture_is_painted_at_the_size_at_which_it_is_solved(units, shown, tmp_path):
    stroke = f'type = "shadow"\nunits = "{units}"\npolygon = [[0, 0], [1, 0], [1, 1]]'
    painted = f'kind = "strokes"\n[[target.strokes]]\n{stroke}\n'
    settings = SMALL.replace("[renderer]\n", f"{painted}[renderer]\npixels = 1024\n")
    assert settings != SMALL
    (tmp_path / "edit.toml").write_text(settings)
    with served(tmp_path / "edit.toml") as server:
        assert sizes_shown(server) == {(source, 0): (width, width) for source, width in enumerate(shown)}


def test_what_is_saved_is_the_solution_that_is_shown(tmp_path):
    (tmp_path / "edit.toml").write_text(SMALL)
    folder = tmp_path / "edit_out"
    erased = {"type": "erase-shadow", "ellipse": [0.62, 0.3, 0.12, 0.12], "softness": 0.05}
    with served(tmp_path / "edit.toml") as server, connected(server) as page:
        heard(page, "opened")
        wanted = {"strokes": [erased], "rest": "follow", "tilt_degrees": 4, "horizon_degrees": -3}
        send(page, "document", number=1, document=wanted)
        heard(page, "status", lambda m: m.get("number") == 1 and m["iterations"] > 1)
        send(page, "save")
        shown = {}
        while not isinstance(received := page.recv(timeout=120), str) or '"type":"saved"' not in received:
            if isinstance(received, bytes) and received[4] == 0:
                shown[received[5]] = struct.unpack("<H", received[6:8])[0]
        saved = json.loads(received)
        assert shown[2] == 2 * 48, "a sharp picture was replaced by a coarse one"
        assert "the picture differs from the one shown before by 0.0" in saved["notes"][0]
        assert not any(note.startswith("target.hold = ") for note in saved["notes"]), saved
        kept = folder / "painted.toml"
        assert 'start = "painted.npz"' in kept.read_text()
        again = pipeline.run(config.load(kept), folder=None)
        stored, _ = images.load_envmap(str(folder / "edited.exr"), 64)
        assert np.array_equal(again.envmap, stored), "envedit run makes another map"
        assert np.array_equal(server.worker.session.solution.edited, stored), "not what is shown"
        assert not any("start " in note for note in again.notes), "another start was chosen"
    with served(kept) as server, connected(server) as page:
        heard(page, "opened")
        hold = server.worker.session.solution.hold
        assert hold == FOLLOWING, "the saved solution is not what is opened"
        painted(page, 1, wanted | {"exposure": 1.0})
        assert 'start = "painted.npz"' in kept.read_text(), "the solution of what is adjusted is lost"
        painted(page, 2, {"strokes": [erased, erased]})
        assert not {"start", "iterations"} & set(kept.read_text().split()), "the solution of other strokes"


def test_strokes_belong_to_the_view_that_was_painted_in_and_others_hold(tmp_path, here):
    write_scene(tmp_path, *TWO_VIEWS, LIGHT, name="scene.xml")
    (tmp_path / "edit.toml").write_text(OF_TWO)
    square = {"rectangle": [0.3, 0.3, 0.7, 0.7], "softness": 0.05}
    light, shadow = {"type": "light", "amount": 0.1, **square}, {"type": "shadow", "amount": 0.4, **square}

    with served(tmp_path / "edit.toml") as server, connected(server) as page:
        assert heard(page, "opened")["views"] == ["front", "behind"]
        session, count = server.worker.session, 0

        def solved(*strokes):
            """Return what strokes ask for in each view, and what the solution leaves of it."""
            nonlocal count
            count += 1
            send(page, "document", number=count, document={"strokes": strokes})
            heard(page, "status", lambda m: m.get("number") == count and m["state"] == "done")
            now = session.solution
            under = now.coverage
            changes = now.target - now.base, under * (now.target - now.point.rendering)
            return [change[rows] for change in changes for rows in session.scene.rows]

        front, behind, _, _ = solved({**shadow, "view": 1})
        assert not front.any() and behind[10:18, 11:21].mean() < -0.02 and not behind[0].any()
        front, behind, *left = solved(light, {**shadow, "view": "behind"})
        assert front[6:14, 11:21].mean() > 0.05 and behind[10:18, 11:21].mean() < -0.02
        for asked, rest in zip((front, behind), left, strict=True):
            assert np.square(rest).sum() < 0.5 * np.square(asked).sum(), "not solved for together"
        assert sizes_shown(server, 2) == {
            (0, 0): (32, 20),
            (0, 1): (32, 28),
            (1, 0): (64, 40),
            (1, 1): (64, 56),
        }
        before = session.document
        send(page, "document", document={"strokes": [{**light, "view": 2}]})
        given = heard(page, "document")
        assert given["client"] == "" and protocol.document(given["document"]) == before == session.document
        assert "got view 2, expected one of 0 (front), 1 (behind)" in heard(page, "error")["text"]
        with connected(server) as later:
            assert protocol.document(heard(later, "opened")["document"]) == before
        send(page, "open", name="edit.toml", envmap="missing.exr")
        assert "missing.exr" in heard(page, "error")["text"] and server.worker.session is session
        toward = []
        for view in (0, 1):
            send(page, "pick", x=0.5, y=0.5, light=0, view=view)
            toward.append(heard(page, "picked")["azimuth"])
        assert abs((toward[1] - toward[0]) % 360 - 180) < 60, toward

    with open(tmp_path / "edit_out" / "painted.toml", "a") as file:
        file.write('\n[[target.strokes]]\ntype = "light"\nview = 5\nellipse = [0.5, 0.5, 0.1, 0.1]\n')
    with served(tmp_path / "edit.toml") as server, connected(server) as page:
        opened = heard(page, "opened")
        assert protocol.document(opened["document"]) == before
        assert "strokes[2].view: got view 5" in opened["notes"][0] and "left out" in opened["notes"][0]


def test_a_scene_is_opened_from_the_start_page_and_mistakes_are_told(tmp_path, here):
    (tmp_path / "edit.toml").write_text(SMALL)
    with served(None) as server, connected(server) as page:
        assert "sphere" in heard(page, "start")["scenes"]
        put = {"method": "PUT", "data": b"#?RADIANCE", "headers": {"Origin": server.origins[0]}}
        for name in ("..%2fout.exr", "out.py", ".exr", "a%00.exr"):
            assert asked(f"{server.url}map/{name}", **put)[0] in (400, 403, 404), name
        assert asked(f"{server.url}map/a.hdr", **{**put, "headers": {}})[0] == 403
        code, path = asked(f"{server.url}map/a.hdr", **put)
        assert code == 200 and path == "maps/a.hdr" and Path(path).read_bytes() == b"#?RADIANCE"
        again = (
            asked(f"{server.url}map/a.hdr", **put),
            asked(f"{server.url}map/a.hdr", **put | {"data": b"other"}),
        )
        assert again == ((200, "maps/a.hdr"), (200, "maps/a-2.hdr"))  # another map replaces none
        assert sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*.*")) == [
            "edit.toml",
            "maps/a-2.hdr",
            "maps/a.hdr",
        ]
        assert Path(path).read_bytes() == b"#?RADIANCE"
        Path("maps").rename("kept")
        Path("maps").write_text("in the way")
        code, text = asked(f"{server.url}map/b.hdr", **put)
        assert code == 500 and text.startswith("not written: ") and "maps" in text, text
        send(page, "save")
        assert "no scene is open" in heard(page, "error")["text"]
        send(page, "open", name="nowhere.toml")
        assert "no such configuration" in heard(page, "error")["text"]
        send(page, "open", name="edit.toml", envmap="missing.exr")
        assert "missing.exr" in heard(page, "error")["text"]
        send(page, "open", name="edit.toml")
        assert heard(page, "opened")["width"] == 48


def test_a_look_gives_the_painting_another_map(tmp_path, here):
    """Strokes and added lights stay, the map is a file, and the painting before is as it was."""
    (tmp_path / "edit.toml").write_text(SMALL)
    key = looks.RoleLight(azimuth=250.0, elevation=20.0, flux=1.5, radius=0.0, tint=(1.6, 0.89, 0.2))
    look = looks.to_toml(looks.Look(lights={"key": key}))
    stroke = {"type": "shadow", "polygon": [[0.4, 0.7], [0.6, 0.7], [0.5, 0.9]], "amount": 0.3}
    added = {"azimuth": 10.0, "elevation": 50.0, "flux": [1.0, 1.0, 1.0], "size": 3.0}
    own = {"light": 1, "flux": [0.5, 0.5, 0.5], "size": 1.0}
    with served(tmp_path / "edit.toml") as server, connected(server) as socket:
        heard(socket, "opened")
        document = {"strokes": [stroke], "lights": [own, added], "tilt_degrees": 5.0}
        painted(socket, 1, document)
        before = server.worker.session.map
        kept = (tmp_path / "edit_out" / "painted.toml").read_bytes()
        send(socket, "look", name="../dusk now.toml", text=look)
        opened = heard(socket, "opened")
        assert "maps/sunsky_dusk_now.exr" in heard(socket, "note")["text"]
        assert len(opened["document"]["strokes"]) == 1 and opened["document"]["tilt_degrees"] == 5
        assert [light.get("light") for light in opened["document"]["lights"]] == [None]
        written = images.read("maps/sunsky_dusk_now.exr")[0]
        assert np.array_equal(written, look_transfer.apply(before, looks.parse(look, "look")))
        assert np.array_equal(server.worker.session.map, written)
        assert server.worker.session.project.folder == tmp_path / "edit_out-2"
        assert (tmp_path / "edit_out" / "painted.toml").read_bytes() == kept
        # ---- What is no look is refused, and the painting stays
        session = server.worker.session
        send(socket, "look", name="bad.toml", text=look.replace("flux", "fluxx"))
        assert "bad.toml: key.fluxx: unknown key" in heard(socket, "error")["text"]
        assert server.worker.session is session and os.listdir("maps") == ["sunsky_dusk_now.exr"]
