// The level of the map: its equator as a line, with a grip in the middle (horizon) and one at the right (tilt).

import { $, ARROWS, clamp, consume, follow } from "./elements.js";
import { seen } from "./orientation.js";

const GRIPS = { // which degrees it changes, which way upwards is, and where on the equator of the file it is
  horizon: { key: "horizon_degrees", up: 1, azimuth: 180, most: 90 },
  tilt: { key: "tilt_degrees", up: -1, azimuth: 270, most: 180 },
};
const STEP = 0.5, LARGE_STEP = 5; // degrees of an arrow key

export class Level {
  constructor(on) {
    Object.assign(this, { holder: $("level-line"), on }); // on: document(), preview(change), done(change)
    for (const name of Object.keys(GRIPS)) {
      $(`grip-${name}`).addEventListener("pointerdown", (event) => this.drag(event, name));
      $(`grip-${name}`).addEventListener("keydown", (event) => this.key(event, name));
    }
    $("level").addEventListener("click", () => this.toggle());
  }

  toggle() {
    const hidden = !this.holder.hidden;
    this.holder.hidden = $("level-degrees").hidden = $("level-hint").hidden = hidden;
    $("level").ariaPressed = String(!hidden);
    this.draw();
  }

  // What a grip changes, moved upwards by degrees from where it was.
  moved(name, before, degrees) {
    const { key, up, most } = GRIPS[name];
    return { [key]: Math.round(100 * clamp(before + up * degrees, -most, most)) / 100 };
  }

  drag(event, name) {
    if (event.button !== 0) return;
    consume(event);
    const grip = event.currentTarget, start = event.clientY, height = $("map-stack").getBoundingClientRect().height;
    const before = this.on.document()[GRIPS[name].key];
    let change = null;
    grip.focus();
    follow(grip, event, (e) => {
      change = this.moved(name, before, ((start - e.clientY) / height) * 180);
      this.on.preview(change);
    }, () => { if (change) this.on.done(change); });
  }

  key(event, name) {
    const move = ARROWS[event.key];
    if (!move) return;
    consume(event);
    this.on.done(this.moved(name, this.on.document()[GRIPS[name].key], (move[0] + move[1]) * (event.shiftKey ? LARGE_STEP : STEP)));
  }

  draw(document = this.on.document()) {
    if (this.holder.hidden) return;
    const equator = Array.from({ length: 145 }, (_, i) => seen(document, { azimuth: 2.5 * i, elevation: 0 }));
    equator.sort((a, b) => a.azimuth - b.azimuth);
    this.holder.querySelector("polyline").setAttribute("points", equator.map(({ azimuth, elevation }) => `${azimuth},${90 - elevation}`).join(" "));
    for (const [name, { key, azimuth }] of Object.entries(GRIPS)) {
      const grip = $(`grip-${name}`), at = seen(document, { azimuth, elevation: 0 }), degrees = document[key];
      grip.style.left = `${at.azimuth / 3.6}%`;
      grip.style.top = `${(90 - at.elevation) / 1.8}%`;
      Object.assign(grip, { ariaValueNow: degrees, ariaValueText: `${degrees} degrees` });
    }
  }
}
