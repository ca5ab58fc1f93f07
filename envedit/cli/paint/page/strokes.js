// Pointer, pen and keyboard on the rendering: strokes as the configuration has them ([[target.strokes]]).

import { ARROWS, clamp, consume } from "./elements.js";

const STEP = 0.015; // of the width, for the arrow keys

export class Strokes {
  constructor(overlay, options, on) {
    this.overlay = overlay;
    this.options = options; // () => {type, picks, shape, size, softness, ...}
    this.on = on; // preview(stroke), done(stroke), drag(phase, x, y, event)
    this.cursor = [0.5, 0.5];
    this.shown = false;
    this.reset();
    overlay.addEventListener("pointerdown", (e) => this.down(e));
    overlay.addEventListener("pointermove", (e) => this.move(e));
    overlay.addEventListener("pointerup", (e) => this.up(e));
    overlay.addEventListener("pointercancel", () => this.cancel());
    overlay.addEventListener("pointerleave", () => { this.hover = null; this.draw(); });
    overlay.addEventListener("dblclick", () => this.close());
    overlay.addEventListener("keydown", (e) => this.key(e));
    overlay.addEventListener("focus", () => { this.shown = overlay.matches(":focus-visible"); this.draw(); });
    overlay.addEventListener("blur", () => { this.shown = false; this.draw(); });
  }

  reset() { this.points = []; this.pressures = []; this.drawing = false; this.corners = false; }

  at(event) {
    const box = this.overlay.getBoundingClientRect();
    return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height].map((v) => clamp(v, 0, 1));
  }

  down(event) {
    if (event.button !== 0) return;
    this.overlay.setPointerCapture(event.pointerId);
    this.overlay.focus({ preventScroll: true });
    this.shown = false;
    this.begin(this.at(event), event);
  }

  begin(place, event) {
    const { picks, shape } = this.options();
    if (picks) { this.dragging = true; this.on.drag("start", ...place); return; }
    if (shape === "polygon") {
      if (!this.corners) { this.reset(); this.corners = true; }
      const last = this.points.at(-1);
      if (!last || Math.hypot(last[0] - place[0], last[1] - place[1]) > 0.004) this.points.push(place);
      this.tell();
      return;
    }
    this.reset();
    this.drawing = true;
    this.add(place, event);
    this.tell();
  }

  move(event) {
    const place = this.at(event);
    this.hover = place;
    if (this.dragging) { this.on.drag("move", ...place, event); return; }
    if (this.drawing) {
      const all = event.getCoalescedEvents?.() ?? [];
      for (const one of all.length ? all : [event]) this.add(this.at(one), one);
      this.tell();
    }
    this.draw();
  }

  add(place, event) {
    if (event?.pointerType === "pen" && event.pressure > 0) this.pressures.push(event.pressure);
    if (this.options().shape === "brush") {
      const last = this.points.at(-1);
      if (!last || Math.hypot(last[0] - place[0], last[1] - place[1]) > 0.003) this.points.push(place);
    } else this.points = [this.points[0] ?? place, place];
  }

  up(event) {
    if (this.dragging) { this.dragging = false; this.on.drag("end", ...this.at(event)); return; }
    if (this.drawing) this.finish();
  }

  finish() {
    const stroke = this.stroke();
    this.reset();
    if (stroke) this.on.done(stroke);
    else this.on.cancel();
    this.draw();
  }

  close() { if (this.corners) this.finish(); }

  cancel() { this.reset(); this.dragging = false; this.on.cancel(); this.draw(); }

  key(event) {
    const move = ARROWS[event.key], step = STEP * (event.shiftKey ? 4 : 1);
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (move) {
      this.shown = true;
      this.cursor = [clamp(this.cursor[0] + step * move[0], 0, 1), clamp(this.cursor[1] - step * move[1], 0, 1)];
      if (this.dragging) this.on.drag("move", ...this.cursor);
      else if (this.drawing) { this.add(this.cursor); this.tell(); }
    } else if (event.key === " ") {
      if (this.dragging) { this.dragging = false; this.on.drag("end", ...this.cursor); }
      else if (this.drawing) this.finish();
      else this.begin(this.cursor);
    } else if (event.key === "Enter") this.close();
    else if (event.key === "Escape" && (this.dragging || this.drawing || this.corners)) this.cancel();
    else return;
    consume(event);
    this.draw();
  }

  tell() {
    const stroke = this.stroke();
    if (stroke) this.on.preview(stroke);
    this.draw();
  }

  // The stroke so far, or null where it has no extent yet.
  stroke() {
    const o = this.options(), p = this.points;
    if (!p.length) return null;
    const made = { type: o.type, softness: o.softness, opacity: o.opacity };
    if (o.type === "light" || o.type === "shadow") Object.assign(made, { amount: o.amount, color: o.color });
    if (o.type === "contrast") made.amount = o.amount;
    if (o.view) made.view = o.view;
    if (o.type === "temperature") made.kelvin = o.kelvin;
    if (o.type === "blur") made.radius = o.radius;
    const pressure = this.pressures.length ? this.pressures.reduce((a, b) => a + b) / this.pressures.length : 0.5;
    const width = rounded(o.size * Math.min(2, 2 * pressure));
    if (o.shape === "brush") return { ...made, points: simplified(p, o.size / 40).map((q) => q.map(rounded)), width };
    if (o.shape === "line") return { ...made, points: p.map((q) => q.map(rounded)), width };
    if (o.shape === "polygon") return p.length < 3 ? null : { ...made, polygon: p.map((q) => q.map(rounded)) };
    const [[x0, y0], [x1, y1]] = [p[0], p.at(-1)];
    if (Math.abs(x1 - x0) < 0.004 || Math.abs(y1 - y0) < 0.004) return null;
    if (o.shape === "rectangle") {
      return { ...made, rectangle: [Math.min(x0, x1), Math.min(y0, y1), Math.max(x0, x1), Math.max(y0, y1)].map(rounded) };
    }
    return { ...made, ellipse: [(x0 + x1) / 2, (y0 + y1) / 2, Math.abs(x1 - x0) / 2, Math.abs(y1 - y0) / 2].map(rounded) };
  }

  draw() {
    const box = this.overlay.getBoundingClientRect();
    if (this.overlay.width !== Math.round(box.width)) Object.assign(this.overlay, { width: Math.round(box.width), height: Math.round(box.height) });
    const pen = this.overlay.getContext("2d"), { width, height } = this.overlay;
    pen.clearRect(0, 0, width, height);
    const o = this.options(), place = this.shown ? this.cursor : this.hover;
    const stroke = this.drawing && this.stroke();
    for (const one of [...o.outlined, ...(stroke ? [stroke] : [])]) outline(pen, one, width, height);
    if (place && !o.picks) {
      const radius = o.shape === "brush" || o.shape === "line" ? Math.max(2, (o.size * width) / 2) : 4;
      for (const [color, line] of [["#000", 3], ["#fff", 1.2]]) {
        pen.strokeStyle = color;
        pen.lineWidth = line;
        pen.beginPath();
        pen.arc(place[0] * width, place[1] * height, radius, 0, 7);
        pen.stroke();
      }
    }
    if (this.corners) {
      pen.strokeStyle = "#fff";
      pen.lineWidth = 1.5;
      pen.beginPath();
      for (const [x, y] of this.points) pen.lineTo(x * width, y * height);
      pen.stroke();
      for (const [x, y] of this.points) pen.strokeRect(x * width - 3, y * height - 3, 6, 6);
    }
  }
}

// A brush by its middle line, everything else by its border.
function outline(pen, stroke, width, height) {
  pen.beginPath();
  if (stroke.ellipse) {
    const [x, y, rx, ry, degrees = 0] = stroke.ellipse;
    pen.ellipse(x * width, y * height, rx * width, ry * height, (degrees * Math.PI) / 180, 0, 7);
  } else if (stroke.rectangle) {
    const [x0, y0, x1, y1] = stroke.rectangle;
    pen.rect(x0 * width, y0 * height, (x1 - x0) * width, (y1 - y0) * height);
  } else {
    for (const [x, y] of stroke.polygon ?? stroke.points ?? []) pen.lineTo(x * width, y * height);
    if (stroke.polygon) pen.closePath();
  }
  for (const [color, line] of [["#000", 3], ["#fff", 1.2]]) {
    pen.strokeStyle = color;
    pen.lineWidth = line;
    pen.stroke();
  }
}

const rounded = (v) => Math.round(v * 1e4) / 1e4;

// Douglas and Peucker (1973): leave out points that lie within a tolerance of the line without them.
function simplified(points, tolerance) {
  if (points.length < 3) return points;
  const [a, b] = [points[0], points.at(-1)], length = Math.hypot(b[0] - a[0], b[1] - a[1]);
  let worst = 0, at = 0;
  points.forEach(([x, y], i) => {
    const off = length > 0 ? Math.abs((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / length : Math.hypot(x - a[0], y - a[1]);
    if (off > worst) [worst, at] = [off, i];
  });
  if (worst <= tolerance) return [a, b];
  return [...simplified(points.slice(0, at + 1), tolerance).slice(0, -1), ...simplified(points.slice(at), tolerance)];
}
