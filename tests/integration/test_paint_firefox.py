"""``envedit paint`` in Firefox: a shadow painted, a light dragged, undone."""

import pytest

from tests.oracles.firefox import FIREFOX, firefox
from tests.oracles.painting import SMALL, served, until

pytestmark = pytest.mark.slow
pytest.importorskip("starlette", reason="the extra envedit[paint] is not installed")
pytest.importorskip("uvicorn", reason="the extra envedit[paint] is not installed")

STATUS = "const s = document.querySelector('[data-testid=status]'); "
PIXELS = "return document.querySelector('[data-testid=map]').toDataURL();"
DRAWN = """
const map = document.querySelector('[data-testid=map]');
const copy = document.createElement('canvas').getContext('2d');
copy.drawImage(map, 0, 0);
return copy.getImageData(0, 0, 300, 150).data.some((value, at) => at % 4 < 3 && value > 0);
"""


@pytest.mark.skipif(FIREFOX is None, reason="no firefox on this machine")
def test_the_map_follows_paint_and_lights(tmp_path):
    (tmp_path / "profile").mkdir()
    (tmp_path / "edit.toml").write_text(SMALL)
    kept = tmp_path / "edit_out" / "painted.toml"
    with served(tmp_path / "edit.toml") as server, firefox(tmp_path / "profile") as page:

        def settled():
            until(
                lambda: page.run(STATUS + "return s.dataset.state === 'done' && Number(s.dataset.frame) > 0;")
            )

        page("WebDriver:Navigate", url=server.url)
        settled()
        until(lambda: page.run(DRAWN))  # the map is drawn with the next frame, after the status
        begun = page.run(PIXELS)
        page.run("document.querySelector('[data-testid=tool-shadow]').click();")
        x, y, width, height = page.box("#overlay")
        page.drag(*((x + (0.2 + 0.1 * k) * width, y + 0.82 * height) for k in range(5)))
        until(lambda: kept.exists() and 'type = "shadow"' in kept.read_text())
        until(lambda: page.run(PIXELS) != begun)  # a state of before the stroke may be "done"
        settled()
        page.run("document.querySelector('[data-testid=undo]').click();")
        until(lambda: "[[target.strokes]]" not in kept.read_text())
        until(lambda: page.run(PIXELS) == begun)
        settled()
        x, y, width, height = page.box("[data-testid=handle-1]")
        page.drag(*((x + width / 2 - 15 * k, y + height / 2) for k in range(4)))
        until(lambda: "[[input.lights]]" in kept.read_text())
        until(lambda: page.run(PIXELS) != begun)
