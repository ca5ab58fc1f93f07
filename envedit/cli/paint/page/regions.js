// Regions of the map as in [[input.regions]]: painted by a brush, shown over the map, and changed in a panel.

import { $, ARROWS, button, clamp, consume, follow, slides } from "./elements.js";
import { hex, linear } from "./lights.js";
import { direction, unseen } from "./orientation.js";

const WIDTH = 256, HEIGHT = 128; // pixels of what is shown over the map
const COLOURS = { keep: [90, 230, 120], scale: [110, 170, 255], fill: [255, 120, 90] };
const NAMES = { keep: "keep", scale: "dim or tint", fill: "fill" };
const MOST_POINTS = 500; // as config/region_schema.py has it
const INPUTS = ["action", "radius", "softness", "stops", "color"].map((name) => `region-${name}`);
const RADIANS = Math.PI / 180;

export class Regions {
  constructor(on) {
    Object.assign(this, { holder: $("handles"), canvas: $("regions"), on }); // on: document(), preview(change), done(change)
    const { holder, canvas } = this;
    this.context = canvas.getContext("2d");
    this.chosen = -1;
    this.cursor = null;
    this.points = null; // of the stroke that is being painted
    holder.addEventListener("pointerdown", (event) => this.down(event));
    holder.addEventListener("pointermove", (event) => this.hover(event));
    holder.addEventListener("pointerleave", () => { this.cursor = null; this.draw(); });
    canvas.addEventListener("keydown", (event) => this.key(event));
    $("region").addEventListener("click", () => this.toggle());
    $("region-remove").addEventListener("click", () => this.remove());
    for (const input of INPUTS.map($)) slides(input, () => this.change(false), () => this.change(true));
  }

  get active() { return !this.canvas.hidden; }
  list() { return this.on.document().regions ?? []; }

  toggle() {
    this.canvas.hidden = $("region-panel").hidden = this.active;
    $("region").ariaPressed = String(this.active);
    this.holder.classList.toggle("brushing", this.active);
    this.points = this.cursor = null;
    this.draw();
  }

  // What the panel is set to: keys of a region without its place.
  settings() {
    const action = $("region-action").value;
    return { action, softness: Number($("region-softness").value), factor: action === "scale" ? this.factor() : undefined };
  }
  get radius() { return Number($("region-radius").value); }

  // What light of a region is multiplied by, from the panel.
  factor() {
    const tint = linear($("region-color").value), most = Math.max(...tint, 1e-3);
    return tint.map((v) => Number(((v / most) * 2 ** Number($("region-stops").value)).toPrecision(5)));
  }

  // ---- the brush

  // The place of the file under a pointer, [azimuth, elevation].
  at(event) {
    const box = $("map-stack").getBoundingClientRect();
    return this.place(360 * clamp((event.clientX - box.x) / box.width, 0, 1), 90 - 180 * clamp((event.clientY - box.y) / box.height, 0, 1));
  }
  place(azimuth, elevation) {
    const there = unseen(this.on.document(), { azimuth, elevation });
    return [there.azimuth, there.elevation].map((v) => Math.round(100 * v) / 100);
  }

  down(event) {
    if (!this.active || event.button !== 0 || event.target !== this.holder) return;
    event.preventDefault();
    this.begin(this.at(event));
    follow(this.holder, event, null, () => this.end(), () => this.cancel());
  }

  hover(event) {
    if (!this.active) return;
    this.cursor = this.at(event);
    if (this.points) this.go(this.cursor);
    this.draw();
  }

  begin(place) { this.points = [place]; this.draw(); }
  go(place) {
    const far = angle(toward(this.points.at(-1)), toward(place)) / RADIANS;
    if (far >= Math.max(0.25, this.radius / 4) && this.points.length < MOST_POINTS) this.points.push(place);
  }
  end() {
    if (!this.points) return;
    const region = { ...this.settings(), points: this.points, radius: this.radius };
    this.points = null;
    this.on.done({ regions: [...this.list(), region] });
    this.choose(this.list().length - 1);
  }

  cancel() { this.points = null; this.draw(); }

  // Arrows move the brush, space begins and ends a stroke.
  key(event) {
    const move = ARROWS[event.key];
    if (move) {
      const step = event.shiftKey ? 10 : 2, { azimuth, elevation } = this.keyed ?? { azimuth: 180, elevation: 30 };
      this.keyed = { azimuth: (azimuth + step * move[0] + 360) % 360, elevation: clamp(elevation + step * move[1], -90, 90) };
      this.cursor = this.place(this.keyed.azimuth, this.keyed.elevation);
      if (this.points) this.go(this.cursor);
    } else if (event.key === " " && this.cursor) this.points ? this.end() : this.begin(this.cursor);
    else if (event.key === "Escape" && this.points) this.points = null;
    else if (event.key === "Delete") this.remove();
    else return;
    this.draw();
    consume(event);
  }

  // ---- the panel

  choose(index) {
    this.chosen = index;
    const region = this.list()[index];
    if (region) {
      $("region-action").value = region.action;
      $("region-softness").value = region.softness ?? 0;
      if (region.radius) $("region-radius").value = region.radius;
      const most = Math.max(0, ...(region.factor ?? []));
      if (most) { // black has no colour
        $("region-stops").value = Math.round(100 * Math.log2(most)) / 100;
        $("region-color").value = hex(region.factor.map((v) => v / most));
      }
    }
    this.draw();
  }

  // The chosen region is changed, if there is one; what is painted next will be so in any case.
  change(done) {
    const region = this.list()[this.chosen];
    if (INPUTS.map($).some((input) => !input.checkValidity())) {
      if (done) this.choose(this.chosen);
      return;
    }
    if (region) {
      const changed = { ...region, ...this.settings() };
      if (region.points) changed.radius = this.radius;
      const regions = this.list().map((one) => (one === region ? changed : one));
      if (done) this.on.done({ regions });
      else this.on.preview({ regions });
    }
    this.draw();
  }

  remove() {
    const region = this.list()[this.chosen];
    if (!region) return;
    this.chosen = -1;
    this.on.done({ regions: this.list().filter((one) => one !== region) });
  }

  draw() {
    const regions = this.list(), list = $("region-list");
    if (!regions[this.chosen]) this.chosen = -1;
    while (list.children.length > regions.length) list.lastChild.remove();
    regions.forEach(({ action }, i) => {
      const chip = list.children[i] ?? list.appendChild(this.chip(i));
      chip.textContent = `${i + 1} ${NAMES[action]}`;
      chip.ariaPressed = String(i === this.chosen);
    });
    $("region-remove").disabled = this.chosen < 0;
    $("region-scaled").hidden = $("region-action").value !== "scale";
    if (this.active) this.shade(regions);
  }

  chip(i) {
    const title = "Choose this region; again: none";
    return button(`region-${i + 1}`, "", { title }, () => this.choose(i === this.chosen ? -1 : i));
  }

  // ---- what is shown over the map

  shade(regions) {
    const directions = this.directions(), image = this.context.createImageData(WIDTH, HEIGHT);
    const over = ([r, g, b], alpha) => {
      for (let i = 0; i < alpha.length; i++) {
        if (alpha[i] <= image.data[4 * i + 3] / 255) continue;
        image.data.set([r, g, b, 255 * alpha[i]], 4 * i);
      }
    };
    regions.forEach((region, i) => over(COLOURS[region.action], this.weights(region, i === this.chosen ? 0.65 : 0.4)));
    const now = { ...this.settings(), radius: this.radius };
    const points = this.points ?? (this.cursor ? [this.cursor] : null);
    if (points) over(COLOURS[now.action], weightsOf(directions, { ...now, points }, this.points ? 0.65 : 0.3));
    this.context.putImageData(image, 0, 0);
  }

  // Weights of a region times `most`; those of regions that have not changed are kept.
  weights(region, most) {
    this.known ??= new Map();
    const key = JSON.stringify([region, most, this.turned]);
    if (!this.known.has(key)) {
      if (this.known.size > 200) this.known.clear();
      this.known.set(key, weightsOf(this.directions(), region, most));
    }
    return this.known.get(key);
  }

  // Where in the file the pixels are: azimuth and elevation in degrees, and unit vectors.
  directions() {
    const now = this.on.document(), turned = JSON.stringify([now.rotate_degrees, now.tilt_degrees, now.horizon_degrees]);
    if (this.turned === turned) return this.places;
    const places = Array.from({ length: WIDTH * HEIGHT }, (_, i) => {
      const { azimuth, elevation } = unseen(now, { azimuth: (360 * ((i % WIDTH) + 0.5)) / WIDTH, elevation: 90 - (180 * (Math.floor(i / WIDTH) + 0.5)) / HEIGHT });
      return [azimuth, elevation, ...toward([azimuth, elevation])];
    });
    return Object.assign(this, { turned, places }).places;
  }
}

// images/map_regions.py; a polygon without its soft edge.
function weightsOf(places, { points, radius, polygon, softness }, most) {
  const fade = Math.max(softness ?? 0, 180 / HEIGHT), weights = new Float32Array(places.length);
  const ends = points?.map(toward), arcs = ends && (ends.length > 1 ? ends.slice(1).map((b, i) => [ends[i], b]) : [[ends[0], ends[0]]]);
  places.forEach(([azimuth, elevation, ...at], i) => {
    if (polygon) { weights[i] = most * within(polygon, azimuth, elevation); return; }
    let away = Infinity;
    for (const [a, b] of arcs) away = Math.min(away, fromArc(at, a, b));
    const t = clamp(1 + (radius - away / RADIANS) / fade, 0, 1);
    weights[i] = most * t * t * (3 - 2 * t);
  });
  return weights;
}

function within(corners, azimuth, elevation) {
  let inside = false;
  for (const turn of [-720, -360, 0, 360]) {
    let odd = false;
    corners.forEach(([x0, y0], i) => {
      const [x1, y1] = corners[(i + 1) % corners.length];
      if ((y0 > elevation) !== (y1 > elevation) && azimuth + turn < x0 + ((elevation - y0) * (x1 - x0)) / (y1 - y0)) odd = !odd;
    });
    inside ||= odd;
  }
  return Number(inside);
}

const toward = ([azimuth, elevation]) => direction({ azimuth, elevation });
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const angle = (a, b) => Math.acos(clamp(dot(a, b), -1, 1));

// The angle from an arc of a great circle.
function fromArc(at, a, b) {
  const normal = cross(a, b), length = Math.hypot(...normal), ends = Math.min(angle(at, a), angle(at, b));
  if (length < 1e-9) return ends;
  const n = normal.map((v) => v / length);
  if (dot(at, cross(n, a)) < 0 || dot(at, cross(b, n)) < 0) return ends;
  return Math.asin(Math.min(1, Math.abs(dot(at, n))));
}
