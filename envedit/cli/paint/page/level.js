// The level of the map: its equator as a line, with a grip in the middle (horizon) and one at the right (tilt).

import { ARROWS, clamp, consume, follow } from "./elements.js";
import { seen } from "./orientation.js";

const GRIPS = { // which degrees it changes, which way upwards is, and where on the equator of the file it is
  horizon: { key: "horizon_degrees", up: 1, azimuth: 180, most: 90 },
  tilt: { key: "tilt_degrees", up: -1, azimuth: 270, most: 180 },
};
const STEP = 0.5, LARGE_STEP = 5; // degrees of an arrow key

export class Level {
  constructor(stack, holder, button, on) {
    Object.assign(this, { stack, holder, button, on }); // on: document(), preview(change), done(change)
    this.curve = holder.querySelector("polyline");
    this.grips = Object.fromEntries([...holder.querySelectorAll("[data-grip]")].map((grip) => [grip.dataset.grip, grip]));
    for (const [name, grip] of Object.entries(this.grips)) {
      grip.addEventListener("pointerdown", (event) => this.drag(event, name));
      grip.addEventListener("keydown", (event) => this.key(event, name));
    }
    button.addEventListener("click", () => this.toggle());
  }

  toggle() {
    this.holder.hidden = !this.holder.hidden;
    this.button.ariaPressed = String(!this.holder.hidden);
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
    const grip = this.grips[name], start = event.clientY, height = this.stack.getBoundingClientRect().height;
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
    this.curve.setAttribute("points", equator.map(({ azimuth, elevation }) => `${azimuth},${90 - elevation}`).join(" "));
    for (const [name, { key, azimuth }] of Object.entries(GRIPS)) {
      const grip = this.grips[name], at = seen(document, { azimuth, elevation: 0 }), degrees = document[key];
      grip.style.left = `${at.azimuth / 3.6}%`;
      grip.style.top = `${(90 - at.elevation) / 1.8}%`;
      Object.assign(grip, { ariaValueNow: degrees, ariaValueText: `${degrees} degrees` });
    }
  }
}
