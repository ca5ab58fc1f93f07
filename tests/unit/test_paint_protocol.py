"""What page and server say to each other, and ``painted.toml``."""

import json
import os
import resource
import struct
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envedit import config
from envedit.cli import paint
from envedit.cli.paint import picking, project, protocol, session, worker
from envedit.cli.paint.session import Tell
from envedit.core.errors import ConfigError, InputError
from tests.oracles.devices import on_cpu

STROKE = {"type": "shadow", "points": [[0.1, 0.2], [0.3, 0.4]], "width": 0.1}


def message(**more):
    return json.dumps({"type": "document", "document": {}} | more)


@pytest.mark.parametrize(("text", "said"), [
    ("", "expected JSON"),
    ("[" * 5000, "expected JSON"),
    ("[]", "expected one of document, pick"),
    ('{"type": "run"}', "expected one of document, pick"),
    (b"\x00\x01", "expected JSON text"),
    (" " * (protocol.MOST_BYTES + 1), "at most"),
    (message(document=3), "expected keys among"),
    (message(document={"dir": "/"}), "expected keys among"),
    (message(phase="later"), "expected one of drawing"),
    (message(number=-1), "document: expected an integer from 0"),
    (message(document={"exposure": float("nan")}), "expected JSON"),
    (message(document={"exposure": 1e9}), "document.exposure"),
    (message(document={"strokes": [{"type": "x"}]}), r"target.strokes\[0\].type"),
    (message(document={"strokes": [{**STROKE, "width": -1}]}), r"target.strokes\[0\].width"),
    (message(document={"strokes": [STROKE] * 501}), "expected at most 500"),
    (message(document={"strokes": ["unread"] * 501}), "expected at most 500"),
    (message(document={"strokes": [{**STROKE, "points": ["unread"] * 20_001}]}), "expected at most 500"),
    (message(document={"lights": [{"light": 9}]}), r"input.lights\[0\].light"),
    (message(document={"lights": [{"light": 1}, {"light": 1}]}), "more than once"),
    (message(document={"lights": [{"azimuth": 1}]}), "azimuth and elevation"),
    (message(document={"lights": [{"azimuth": 1, "elevation": 1}]}), r"input.lights\[0\].flux"),
    (message(document={"lights": [{"light": 1, "colour": 1}]}), "has no key 'colour'"),
    (message(document={"rest": "stays"}), "document.rest"),
    (message(document={"freedom": 2}), "document.freedom"),
    ('{"type": "pick", "x": 2, "y": 0}', "pick: expected a number"),
    ('{"type": "pick", "x": 0, "y": 0, "of": "glint"}', "pick: expected"),
    ('{"type": "pick", "x": 0, "y": 0, "point": [0, 1]}', "pick: expected a list of 3 numbers"),
    ('{"type": "open"}', "open: expected a string"),
    ('{"type": "open", "name": ""}', "open: expected a string"),
])  # fmt: skip
def test_bad_messages_are_refused_with_what_was_expected(text, said):
    with pytest.raises(protocol.BadMessageError, match=said):
        protocol.read(text)


def test_a_document_goes_through_json_unchanged():
    text = message(document={"strokes": [STROKE], "exposure": 1}, phase="drawing", number=7)
    edit = protocol.read(text, "a")
    assert (edit.phase, edit.number, edit.client, edit.document.exposure) == ("drawing", 7, "a", 1.0)
    assert edit.document.strokes[0]["opacity"] == 1.0
    assert protocol.document(json.loads(json.dumps(edit.document.plain()))) == edit.document


def test_lights_of_the_map_are_listed_by_number_before_those_added():
    layers = SimpleNamespace(lights=SimpleNamespace(flux=np.ones((2, 3))))
    placed = SimpleNamespace(lights=[SimpleNamespace(direction=np.eye(3)[i]) for i in (0, 1)], layers=layers)
    added, second, first = {"azimuth": 1, "elevation": 2, "flux": [1.0] * 3}, {"light": 2}, {"light": 1}

    def listed(*lights):
        document = protocol.document({"lights": lights})
        found = picking.lights(placed, document)
        entries = picking.changed(found, 0, {"muted": True}, document)
        return [one.entry.get("light") for one in found], [one.get("light") for one in entries]

    assert listed(added, second) == ([1, 2, None], [1, 2, None])
    assert listed(added) == ([1, 2, None], [1, None])
    assert listed(added, second, first) == ([1, 2, None], [1, 2, None])
    assert listed(second, {"light": 7}, first) == ([1, 2], [1, 2, 7]), "a light that the map has not is gone"


def test_names_and_roles_move_no_light():
    moved = {"azimuth": 1, "elevation": 2, "flux": [1.0] * 3}
    labelled = [{"light": 1, "role": "key"}, moved | {"name": "softbox", "role": "rim"}]
    plain, other = ({"lights": [moved]}, {"lights": [moved | {"size": 3}]})
    placing = protocol.document(plain).placing
    assert protocol.document({"lights": labelled}).placing == placing
    assert protocol.document(other).placing != placing
    assert protocol.document(plain | {"tilt_degrees": 1}).placing != placing


def test_a_frame_holds_half_floats_and_nothing_that_is_not_finite():
    image = np.float32([[[0.5, 1e6, np.nan], [np.inf, -np.inf, 1e-30]]])
    frame = protocol.frame("map", "mitsuba", 2**32 + 5, image)
    assert struct.unpack("<4sBBHHI", frame[:14]) == (b"EVPF", 1, 1, 2, 1, 5)
    assert np.frombuffer(frame[16:], "<f2").tolist() == [0.5, 65504, 0, 65504, -65504, 0]


def test_painted_toml_is_what_was_given_and_what_was_painted(tmp_path):
    file = tmp_path / "edit.toml"
    text = 'seed = 4\n[input]\nenvmap = "sunsky"\nwidth = 64\n[scene]\nfile = "pair"\n'
    file.write_text(text + "[target]\nhold = 2\n")
    opened = project.opened(str(file))
    assert opened.document == protocol.Document() and not opened.again
    assert opened.folder == tmp_path / "edit_out"
    light = {"azimuth": 10.0, "elevation": 20.0, "flux": [1, 2, 3], "role": "rim"}
    done = protocol.document(
        {"strokes": [STROKE], "lights": [light], "rotate_degrees": 30, "exposure": 0.5, "temperature": 5000}
        | {"rest": "keep", "freedom": 0.5, "tilt_degrees": -3.5, "horizon_degrees": 2}
    )
    opened.keep(done)
    again = project.opened(str(file))
    assert again.again and again.document == done and again.folder == opened.folder
    assert project.opened(str(opened.folder / "painted.toml")).document == done
    settings = config.load(opened.folder / "painted.toml")
    assert (settings.seed, settings.input.width, settings.target.hold) == (4, 64, 2)
    assert settings.input.orientation == (30, -3.5, 2) and settings.input.lights[0]["role"] == "rim"
    assert settings.loss.given == frozenset(), "a default was written as if it had been given"
    opened.keep(protocol.Document())
    assert config.load(opened.folder / "painted.toml").target.kind == "none"
    other = project.opened(str(file), envmap="scene")
    assert other.folder == tmp_path / "edit_out-2", "another map's painting would be overwritten"


@pytest.mark.parametrize("scene", ["", "width = 48\n"])
def test_a_painting_goes_on_under_the_preset_that_is_asked_for(tmp_path, scene):
    file = tmp_path / "edit.toml"
    file.write_text(f'[input]\nenvmap = "sunsky"\n[scene]\n{scene}')
    opened = project.opened(str(file))
    done = protocol.document({"strokes": [STROKE]})
    opened.keep(done)
    for preset in ("draft", None):
        again = project.opened(str(file), preset=preset)
        assert (again.folder, again.document) == (opened.folder, done)
        assert again.settings.preset == (preset or "standard")
        again.keep(done)


def test_a_painting_goes_on_with_what_its_configuration_says_now(tmp_path):
    file = tmp_path / "edit.toml"
    text = '[input]\nenvmap = "sunsky"\nwidth = {}\n'
    file.write_text(text.format(64))
    opened = project.opened(str(file))
    done = protocol.document({"strokes": [STROKE]})
    opened.keep(done, start="painted.npz")
    same = project.opened(str(file))
    assert (same.document, Path(same.start).name, same.note) == (done, "painted.npz", "")
    file.write_text(text.format(32) + "[target]\nhold = 2\n")
    other = project.opened(str(file))
    assert (other.document, other.folder, other.start) == (done, opened.folder, "")
    assert (other.settings.input.width, other.settings.target.hold) == (32, 2)
    assert "Goes on from painted.toml of edit_out" in other.note


def test_two_servers_do_not_paint_in_one_folder(tmp_path, capsys):
    pytest.importorskip("starlette")
    file = tmp_path / "edit.toml"
    file.write_text('[input]\nenvmap = "sunsky"\n')
    opened = project.opened(str(file))
    with opened.alone():
        said = f"edit_out: process {os.getpid()} .* has this painting open"
        with pytest.raises(InputError, match=said), project.opened(str(file)).alone():
            pass
        assert paint.main([str(file), "--no-browser", "--port", "0"]) == 3
        assert "has this painting open: end that `envedit paint`" in capsys.readouterr().err
    with opened.alone():
        assert len(list(opened.folder.iterdir())) == 1
    assert list(opened.folder.iterdir()) == []


@pytest.mark.parametrize("option", [["--camera", "left"], ["--preset", "draft"]])
def test_an_option_of_a_scene_needs_a_scene(option, capsys):
    with pytest.raises(SystemExit, match="2"):
        paint.main([*option, "--no-browser"])
    assert "name one" in capsys.readouterr().err


def test_what_paint_cannot_solve_is_refused(tmp_path):
    file = tmp_path / "edit.toml"
    file.write_text('preset = "paper"\n')
    with pytest.raises(ConfigError, match="expected layers and transport"):
        project.opened(str(file))


@on_cpu
@pytest.mark.skipif(not os.path.exists("/proc/self/statm"), reason="no /proc")
def test_what_is_given_back_leaves_the_process():
    def resident():
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()

    cycle = [dr.arange(mi.Float, 2**25)]
    cycle.append(cycle)
    dr.eval(cycle[0])
    dr.sync_thread()
    del cycle
    kept = resident()
    session.give_back_memory()
    assert kept - resident() > 0.9 * 4 * 2**25


def test_a_stroke_is_solved_for_while_it_is_drawn_however_fast_the_pointer_moves():
    """Something always waits: still each edit is followed by a step."""
    done = []

    class Drawn:
        def update(self, edit):
            done.append("edit")
            painting.post(edit)

        def advance(self):
            done.append("step")
            if len(done) >= 20:
                painting.stop()
            return True

    painting = worker.Worker(Tell())
    painting.session = Drawn()
    painting.post(protocol.Edit(protocol.Document(), "drawing"))
    painting.start()
    painting.join(30)
    painting.stop()
    assert not painting.is_alive() and done[:20] == ["edit", "step"] * 10, done[:20]


def test_what_was_painted_before_is_not_written_into_what_is_opened_next(monkeypatch):
    """A stroke on the first waits while the second is opened; what comes while the first opens is kept."""
    stroke, kept = protocol.Edit(protocol.Document(), "done"), []
    painting = worker.Worker(Tell())

    def opened(_):
        painting.post(stroke)  # drawn on what is still shown
        painting.session = object()

    monkeypatch.setattr(painting, "_open", opened)
    monkeypatch.setattr(worker.project, "opened", lambda *_: None)
    for name in ("first", "second"):
        painting._carry_out(protocol.Open(name))
        kept.append(painting._waiting.pop(protocol.Edit, None))
    assert kept == [stroke, None]


def test_an_edit_of_another_painting_is_left_out():
    """It was under way while a page opened the next one."""
    taken = []

    class Open:
        def update(self, edit):
            taken.append(edit.painting)

    painting = worker.Worker(Tell())
    painting.session, painting._painting = Open(), 2
    text = '{"type": "document", "document": {}, "painting": %d}'
    for number in (1, 2, 0, 3):
        painting._carry_out(protocol.read(text % number))
    assert taken == [2, 0]
