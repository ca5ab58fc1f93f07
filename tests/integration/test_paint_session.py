"""A painting without server and page: how it is solved for, what is said of it, dragged shadows."""

import re

import numpy as np
import pytest

from envedit import config
from envedit.cli.paint import project
from envedit.cli.paint import session as sessions
from envedit.cli.paint.protocol import Edit, Pick, document
from envedit.cli.paint.session import Session, Tell
from envedit.core.rotations import rotation_vector
from tests.oracles.painting import SMALL, photographed

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("own_core")]
ERASED = {"type": "erase-shadow", "ellipse": [0.62, 0.3, 0.12, 0.12], "softness": 0.05}
DARK = {"type": "shadow", "ellipse": [0.75, 0.75, 0.2, 0.1], "softness": 0.03, "amount": 0.8}
DRAGGED = {0.0: ((33, 10), (41, 10)), 40.0: ((40, 8), (31, 8))}
"""Pixels, row and column, from which a shadow is dragged and to which, by the degrees of the sky's turn."""


class Heard(Tell):
    """Keeps the last message, and the last image, of each kind."""

    def __init__(self):
        self.last, self.images = {}, {}

    def frame(self, kind, source, image, rows=(slice(None),)):
        self.images[kind] = image

    def say(self, message):
        self.last[message["type"]] = message


@pytest.fixture(scope="module")
def painting(tmp_path_factory):
    file = tmp_path_factory.mktemp("session") / "edit.toml"
    file.write_text(SMALL)
    heard = Heard()
    return Session(project.opened(str(file)), heard), heard


@pytest.fixture(autouse=True)
def few_samples(monkeypatch):
    """Of the rendering that is shown at the end."""
    monkeypatch.setattr(sessions, "PASSES", sessions.FIRST_PASSES + 1)


def solved(painting, phase="done", **changed):
    """Solve for a document to its end; returns the last status."""
    session, heard = painting
    session.update(Edit(document(changed), phase))
    while session.advance():
        pass
    return heard.last["status"]


def test_freedom_and_the_rest_are_solved_for_anew_and_kept(painting):
    session, _ = painting
    gains, blocks = [], None
    for freedom in (1.0, 0.0):
        solved(painting, "drawing", strokes=[ERASED], freedom=freedom)
        problem, state = session.solution.problem, session.solution.run.state
        finest, last = np.prod(problem.sizes[-1]), problem.nodes - problem.ground
        gains.append(state["gain"][last - finest : last].std(axis=0).max())
        assert blocks in (None, problem.blocks), "blocks were built anew"
        blocks = problem.blocks
    assert gains[1] < 0.2 * gains[0], gains
    assert "freedom" not in session.project.text(session.project.document)

    changes = []
    for rest in ("follow", "keep"):
        status = solved(painting, strokes=[ERASED], freedom=0.0, rest=rest)
        assert ("hold" in status) == (rest == "keep")
        assert 0 < status["reached"] <= status["reachable"] <= 1
        assert "advice" not in status or status["reached"] < 0.5
        solution = session.solution
        bare = solution.coverage[..., 0] == 0
        changes.append(np.abs(solution.point.rendering - solution.base)[bare].mean())
    assert changes[1] < changes[0], "the rest does not stay"
    kept = config.load(session.project.folder / "painted.toml")
    assert (kept.target.rest, kept.solve.freedom) == ("keep", 0.0)
    again = project.opened(str(session.project.folder / "painted.toml")).document
    assert (again.rest, again.freedom) == ("keep", 0.0)
    project_text = session.project.text(document({"rest": "keep"}))
    assert config.loads(project_text, session.project.folder, "painted.toml").target.rest == "keep"


def test_the_gain_is_as_fine_as_the_configuration_asks(tmp_path):
    nodes = []
    for cycles in (3, 12):
        file = tmp_path / f"{cycles}.toml"
        file.write_text(SMALL + f"[representation]\ncycles = {cycles}\n")
        problem = Session(project.opened(str(file)), Heard()).solution.problem
        nodes.append(problem.nodes - problem.ground)
    assert nodes[0] < 0.2 * nodes[1]


def test_advice_is_given_where_little_is_reached(painting):
    session, _ = painting
    nothing = DARK | {"amount": 0.0}
    status = solved(painting, strokes=[nothing, DARK], rest="keep", freedom=0.0)
    assert status["reached"] < 0.5
    told = status["advice"]
    assert told["text"].startswith("stroke 2 (shadow) stays too bright") and "which stays" in told["text"]
    follow, *placed = told["actions"]
    assert follow["change"] == {"rest": "follow"} and placed
    asked = session.solution.request
    for action in placed:  # what is promised is what comes
        promised = float(re.search(r"(\d+) %", action["label"])[1]) / 100
        assert promised > status["reached"]
        session.update(Edit(document(action["change"])))
        assert asked.reached(session.solution.base) == pytest.approx(promised, abs=0.1), action


def test_other_explanations_are_shown_and_gone_on_from(painting):
    session, heard = painting
    reached = solved(painting, strokes=[ERASED])["reached"]
    listed = heard.last["explanations"]["explanations"]
    assert len(listed) > 1 and heard.last["explanations"]["chosen"] == 0
    assert len({one["name"] for one in listed}) == len(listed)
    first = {name: value.copy() for name, value in session.solution.run.state.items()}

    session.choose(1)
    assert heard.last["explanations"]["chosen"] == 1
    while session.advance():
        pass
    other = session.solution.point.rendering
    assert heard.last["status"]["reached"] != reached
    assert np.abs(other - session.solution.base).max() > 0.01
    named = [{"light": 1, "flux": [1.0, 1.0, 1.0], "size": 1.0, "name": "sun"}]
    solved(painting, strokes=[ERASED], exposure=1.0, lights=named)  # change nothing that is solved for
    assert heard.last["explanations"]["chosen"] == 1
    assert np.array_equal(session.solution.point.rendering, other)

    session.choose(0)  # as it was left
    assert all(np.array_equal(session.solution.run.state[name], first[name]) for name in first)
    session.choose(len(listed))  # of what was painted before
    assert heard.last["explanations"]["chosen"] == 0
    solved(painting)
    assert heard.last["explanations"]["explanations"] == []


def test_a_shadow_is_dragged_by_its_tip(painting):
    session, heard = painting

    def picked(row, column, **more):
        session.pick(Pick((column + 0.5) / 48, (row + 0.5) / 48, **{"of": "shadow"} | more))
        return heard.last["picked"]

    for turn, (tip, there) in DRAGGED.items():
        level = {"rotate_degrees": turn, "tilt_degrees": 3.0}
        session.update(Edit(document(level)))
        before = session.solution.base[:, :, 1].copy()
        ((sun, share),) = picked(45, 45, of="shares")["shares"]
        ((_, shaded),) = picked(*tip, of="shares")["shares"]
        assert sun == 0 and 0.3 < share < 1 and shaded < 0.1, "whose light it is"
        found = picked(*tip)
        assert found["light"] == 0 and len(found["point"]) == 3
        to = picked(*there, light=0, point=tuple(found["point"]))
        light = {"light": 1, "azimuth": to["azimuth"], "elevation": to["elevation"]}
        session.update(Edit(document(level | {"lights": [light]})))
        after = session.solution.base[:, :, 1]
        assert after[there] < 0.5 * before[there], "the shadow is not where it was dragged to"
        assert after[tip] > before[tip]
        assert "in no shadow" in picked(45, 45)["text"]
        # ---- A click does the same with the strongest light; to illuminate, one is to be added
        to = picked(*tip, of="cast")
        light |= {"azimuth": to["azimuth"], "elevation": to["elevation"]}
        session.update(Edit(document(level | {"lights": [light]})))
        assert to["light"] == 0
        assert session.solution.base[tip][1] < 0.5 * after[tip], "the shadow does not fall there"
        added = picked(20, 24, of="illuminate")
        assert added["light"] == -1 and -90 <= added["elevation"] <= 90
        centre = session.solution.problem.layers.lights.centres[0]
        session.solution.run.state["turn"][0] = rotation_vector(centre, centre * [-1, 1, -1])
        assert "in no shadow" in picked(*there)["text"], "the light is not where paint has put it"
        assert "no shadow was picked" in picked(45, 45, light=0)["text"]


def test_the_light_of_a_photograph_is_painted_on_beside_it(tmp_path):
    """It is found once; the photograph is shown in the scene's radiance, as the rendering is."""
    file, heard = photographed(tmp_path), Heard()
    session = Session(project.opened(str(file)), heard)
    session.again()
    shown, rendering = heard.images["photograph"], heard.images["before"]
    assert np.corrcoef(shown.ravel(), rendering.ravel())[0, 1] > 0.95
    assert np.median(shown / rendering) == pytest.approx(1, abs=0.1)

    light = {"light": 1, "flux": [2.0, 2.0, 2.0]}
    session.update(Edit(document({"lights": [light]})))
    again = project.opened(str(file))
    assert again.photo is None and len(again.document.lights) == 1, "the light was looked for again"

    photographed(tmp_path, azimuth=200)
    assert project.opened(str(file)).photo is not None, "another photograph was taken for this one"
