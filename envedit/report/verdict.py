"""One line on a run: how near its rendering came to the target."""

from __future__ import annotations

from envedit.losses import metrics


def verdict(measured: dict) -> str:
    """Return the last line of a run, from what ``metrics.json`` has."""
    if measured["painted"]:
        line = metrics.painted_verdict(measured["painted"])
    elif not (measured["iterations"] or measured["envmap"] or measured["initial"]["log_rmse"]):
        measure = "log RMSE" if metrics.saturated([measured["render"]]) else "PSNR"
        score = metrics.score(measured["render"], [])
        line = f"no target; {measure} of the rendering against the initial one {score}"
    else:
        line = f"rendering {_change(measured['initial'], measured['render'])}"
        if measured["envmap"]:
            line += f", map {_change(measured['initial_envmap'], measured['envmap'])}"
        if measured["ceiling"]:
            line += f", noise alone leaves {metrics.score(measured['ceiling'], [measured['render']])}"
    if camera := measured["camera"]:
        line += f"; {camera['summary']}"
    return line + f", {measured['timing']['total_s']:.1f} s"


def _change(before, after):
    """Return two scores, "20.1 -> 35.2 dB", and whether most of the difference is beyond their measure."""
    pair = before, after
    first, last = (metrics.score(one, pair) for one in pair)
    saturated = " (most of the difference is outside the display's range)" if metrics.saturated(pair) else ""
    return f"{first.rpartition(' ')[0]} -> {last}{saturated}"
