// The lights of the map as handles, and the panel of the one that is chosen.
// Entries are as in [[input.lights]]: with `light` one of the map's own, with factors; without it an added one.

import { $, ARROWS, button, clamp, consume, follow, slides } from "./elements.js";
import { seen, unseen } from "./orientation.js";

export class Lights {
  constructor(on) {
    Object.assign(this, { stack: $("map-stack"), holder: $("handles"), on }); // on: document(), preview(change), done(change)
    this.own = [];
    this.found = [];
    this.chosen = -1;
    this.turning = false;
    this.draft = null;
    this.solo = -1;
    this.holder.addEventListener("pointerdown", (e) => this.turn(e));
    for (const key of ["flux", "color", "size", ...SHAPED]) slides($(`light-${key}`), () => this.change(key), () => this.commit());
    $("light-mute").addEventListener("click", () => this.mute());
    $("light-delete").addEventListener("click", () => this.remove());
  }

  set(message) {
    this.own = message.own;
    this.found = message.found;
    this.draw();
  }

  // All lights as they are: {entry, own, azimuth, elevation}, the map's own first, by their numbers (picking.lights of the
  // server is the same).
  list(document = this.draft ?? this.on.document()) {
    const own = this.own.map((light) => {
      const entry = document.lights.find((one) => one.light === light.light) ?? { light: light.light, flux: [1, 1, 1], size: 1 };
      const { azimuth, elevation } = { ...light, ...entry };
      return { entry, own: light, azimuth, elevation };
    });
    const added = document.lights.filter((one) => !one.light).map((entry) => ({ entry, own: null, azimuth: entry.azimuth, elevation: entry.elevation }));
    return [...own, ...added];
  }

  get unit() { return this.own.length ? Math.max(...this.own[0].flux, 1e-6) : 1; }

  // The document's lights with one of them changed, or left out (null), in the order of the list.
  changed(index, change) {
    const { lights } = this.on.document(), all = this.list(this.on.document());
    if (!all[index]) return null;
    const entries = all.flatMap(({ entry }, i) => {
      if (i === index) return change ? [{ ...entry, ...change }] : [];
      return lights.includes(entry) ? [entry] : [];
    });
    const unlisted = lights.filter((one) => !all.some(({ entry }) => entry === one)); // of lights that the map does not have
    return [...entries, ...unlisted];
  }

  preview(index, change) {
    const lights = this.changed(index, change);
    if (lights) this.show(lights);
  }

  show(lights) {
    this.pending = lights;
    this.draft = { ...this.on.document(), lights };
    this.on.preview({ lights });
    this.draw();
  }

  commit() {
    if (!this.pending) return;
    const lights = this.pending;
    this.pending = this.draft = null;
    this.on.done({ lights });
    this.draw();
  }

  // Give up what is shown and not committed.
  drop() { this.pending = this.draft = null; }

  // Move a light by degrees on the map as it is seen.
  moveBy(index, light, dx, dy) {
    const document = this.on.document(), { azimuth, elevation } = seen(document, light);
    const there = unseen(document, { azimuth: azimuth + dx, elevation: clamp(elevation + dy, -90, 90) });
    this.moveTo(index, there.azimuth, there.elevation);
  }

  moveTo(index, azimuth, elevation) {
    this.preview(index, { azimuth: round(((azimuth % 360) + 360) % 360), elevation: round(clamp(elevation, -90, 90)) });
  }

  // Change flux or size of a light as it was when a drag began, by pixels upwards.
  stretch(index, light, pixels, ofFlux) {
    const factor = 2 ** (pixels / PIXELS_A_STOP);
    if (ofFlux) this.preview(index, { flux: light.entry.flux.map((v) => Math.min(1e6, v * factor)) });
    else this.preview(index, { size: clamp(round(light.entry.size * factor), 0.01, mostSize(light)) });
  }

  drag(event, index) {
    if (event.button !== 0 || this.turning) return;
    consume(event);
    this.choose(index);
    const handle = event.currentTarget, box = this.stack.getBoundingClientRect();
    const light = this.list()[index], start = [event.clientX, event.clientY];
    handle.focus();
    follow(handle, event, (e) => {
      const dx = ((e.clientX - start[0]) / box.width) * 360, dy = ((e.clientY - start[1]) / box.height) * 180;
      if (e.shiftKey || e.ctrlKey) this.stretch(index, light, start[1] - e.clientY, e.ctrlKey);
      else if (dx || dy) this.moveBy(index, light, dx, -dy);
    }, () => this.commit());
  }

  key(event, index) {
    const move = ARROWS[event.key];
    if (move) {
      const step = event.shiftKey ? 5 : 1;
      this.moveBy(index, this.list()[index], move[0] * step, move[1] * step);
      this.commit();
    } else if (event.key === "Delete") this.remove();
    else if (event.key === "Enter" || event.key === " ") this.choose(index);
    else return;
    consume(event);
  }

  wheel(event, index) {
    event.preventDefault();
    this.choose(index);
    const input = $(event.shiftKey ? "light-size" : "light-flux");
    input.value = Number(input.value) - Math.sign(event.deltaY || event.deltaX) * 0.2;
    input.dispatchEvent(new Event("input"));
    clearTimeout(this.later);
    this.later = setTimeout(() => this.commit(), 250);
  }

  // Drag the sky sideways.
  turn(event) {
    if (!this.turning || event.button !== 0) return;
    event.preventDefault();
    const start = event.clientX, before = this.on.document().rotate_degrees, width = this.stack.clientWidth;
    let degrees = before;
    follow(this.holder, event, (e) => {
      degrees = round((before - ((e.clientX - start) / width) * 360) % 360);
      this.draft = { ...this.on.document(), rotate_degrees: degrees };
      this.on.preview({ rotate_degrees: degrees });
      this.draw();
    }, () => {
      this.draft = null;
      if (degrees !== before) this.on.done({ rotate_degrees: degrees });
    });
  }

  choose(index) {
    this.chosen = index;
    this.draw();
  }

  change(what) {
    const light = this.list()[this.chosen];
    if (!light) return;
    const { value } = $(`light-${what}`);
    let next = { [what]: Number(value) }; // aspect, rotation, softness
    if (what === "flux" || what === "color") {
      const tint = linear($("light-color").value), most = Math.max(...tint, 1e-3);
      const strength = 2 ** Number($("light-flux").value) * (light.own ? 1 : this.unit);
      next = { flux: tint.map((v) => Math.min(1e6, (v / most) * strength)) };
    }
    if (what === "size") next = { size: Math.min(mostSize(light), round(2 ** Number(value))) };
    if (what === "shape") next = { shape: value, aspect: aspectOf(value), image: undefined };
    this.preview(this.chosen, next);
  }

  // Change a light for good; a key that is undefined is taken out.
  edit(index, change) {
    this.preview(index, change);
    this.commit();
  }

  mute(index = this.chosen) {
    const light = this.list()[index];
    if (!light) return;
    const dark = light.entry.flux.every((v) => v === 0); // of paintings without the key `muted`
    this.edit(index, dark ? { flux: [1, 1, 1], muted: undefined } : { muted: !light.entry.muted || undefined });
  }

  // Show one light alone, until the next edit or until this is asked again; nothing is kept of it.
  hear(index) {
    this.solo = this.solo === index ? -1 : index;
    const lights = this.list().map(({ entry }, i) => (i === this.solo ? entry : { ...entry, muted: true }));
    if (this.solo < 0) this.on.back();
    else this.on.preview({ lights });
    this.draw();
  }

  // One of the map's own can only be muted.
  remove() {
    const light = this.list()[this.chosen];
    if (!light || light.own) return;
    const lights = this.changed(this.chosen, null);
    this.chosen = -1;
    this.on.done({ lights });
    this.draw();
  }

  add() {
    const n = this.list().length;
    this.on.done({ lights: this.withAdded(unseen(this.on.document(), { azimuth: 180 + 40 * n, elevation: 40 })) });
    this.choose(n);
  }

  // The document's lights and another one.
  withAdded({ azimuth, elevation }) {
    const flux = [1, 1, 1].map((v) => v * Math.min(1e6, 0.5 * this.unit));
    return [...this.on.document().lights, { azimuth: round(azimuth), elevation: round(elevation), flux, size: 3 }];
  }

  // Place a light, or another one (-1), until it is committed.
  place(index, { azimuth, elevation }) {
    if (index >= 0) this.moveTo(index, azimuth, elevation);
    else this.show(this.withAdded({ azimuth, elevation }));
    this.choose(index >= 0 ? index : this.list().length - 1);
  }

  draw() {
    const document = this.draft ?? this.on.document(), lights = this.list();
    const place = (element, { azimuth, elevation }) => {
      element.style.left = `${(100 * azimuth) / 360}%`;
      element.style.top = `${(100 * (90 - elevation)) / 180}%`;
    };
    while (this.holder.querySelectorAll(".handle").length > lights.length) [...this.holder.querySelectorAll(".handle")].at(-1).remove();
    lights.forEach((light, i) => {
      let handle = this.holder.querySelectorAll(".handle")[i];
      if (!handle) {
        handle = button(`handle-${i + 1}`, i + 1, { className: "handle" });
        handle.addEventListener("pointerdown", (e) => this.drag(e, i));
        handle.addEventListener("keydown", (e) => this.key(e, i));
        handle.addEventListener("focus", () => this.choose(i));
        handle.addEventListener("wheel", (e) => this.wheel(e, i), { passive: false });
        this.holder.append(handle);
      }
      const muted = off(light);
      handle.classList.toggle("muted", muted);
      handle.ariaPressed = String(i === this.chosen);
      handle.ariaLabel = `${light.own ? "Light" : "Added light"} ${i + 1}${light.entry.name ? `, ${light.entry.name}` : ""}${light.entry.role ? `, ${light.entry.role} light` : ""}: azimuth ${light.azimuth.toFixed(0)}, elevation ${light.elevation.toFixed(0)} degrees${muted ? ", muted" : ""}; arrow keys move it`;
      place(handle, seen(document, light));
    });
    this.holder.querySelectorAll(".found").forEach((ring) => ring.remove());
    const solved = !this.draft && document.strokes.length > 0;
    $("ring-hint").hidden = !solved || !this.found.length;
    if (solved) for (const light of this.found) {
      const ring = Object.assign(window.document.createElement("span"), { className: "found", title: "where the solution has this light" });
      place(ring, light);
      this.holder.append(ring);
    }
    this.fill(lights[this.chosen]);
    this.on.drawn(lights);
  }

  fill(light) {
    $("light").disabled = !light;
    $("light-shaped").hidden = !light || Boolean(light.own);
    $("light-name").textContent = light ? `${light.own ? "Light of the map" : "Added light"} ${this.chosen + 1}` : "No light chosen";
    if (!light) $("light-flux-value").textContent = $("light-size-value").textContent = "";
    if (!light) return;
    const most = Math.max(...light.entry.flux), muted = off(light);
    if (most > 0) {
      $("light-flux").value = Math.log2(most / (light.own ? 1 : this.unit));
      $("light-color").value = hex(light.entry.flux.map((v) => v / most));
    }
    $("light-size").max = light.own ? 4 : 6.5;
    $("light-size").value = Math.log2(light.entry.size);
    const shape = light.entry.shape ?? "gaussian";
    $("light-shape").value = shape;
    $("light-aspect").value = light.entry.aspect ?? aspectOf(shape);
    $("light-rotation").value = light.entry.rotation ?? 0;
    $("light-softness").value = light.entry.softness ?? 0;
    $("light-softness").disabled = shape === "gaussian";
    $("light-flux-value").textContent = muted ? "off" : `${signed(stops(light, this.unit))} st`;
    $("light-size-value").textContent = `${+degrees(light).toPrecision(2)}°`;
    $("light-mute").ariaPressed = String(muted);
    $("light-delete").disabled = Boolean(light.own);
  }
}

const PIXELS_A_STOP = 50; // of a drag with Shift or Ctrl
const mostSize = (light) => (light.own ? 20 : 90); // a factor, or degrees
const SHAPED = ["shape", "aspect", "rotation", "softness"]; // keys of an added light only
const aspectOf = (shape) => (shape === "strip" ? 0.1 : 1); // where none is given
export const off = ({ entry }) => entry.muted || entry.flux.every((v) => v === 0);
// Flux of a light as it is, over that of the map's or, if it was added, over that of the map's strongest.
export const flux = ({ entry, own }) => entry.flux.map((v, c) => v * (own ? own.flux[c] : 1));
export const stops = (light, unit) => Math.log2(luminance(flux(light)) / (light.own ? luminance(light.own.flux) : unit));
export const degrees = ({ entry, own }) => entry.size * (own ? own.radius : 1);
export const luminance = ([r, g, b]) => 0.2126 * r + 0.7152 * g + 0.0722 * b;
export const signed = (v) => `${v < -0.05 ? "−" : v > 0.05 ? "+" : ""}${Math.abs(v).toFixed(1)}`;
const round = (v) => Math.round(v * 100) / 100;
// sRGB of a colour input from and to linear values.
export const linear = (text) => [1, 3, 5].map((i) => parseInt(text.slice(i, i + 2), 16) / 255).map((v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4));
export const hex = (rgb) => "#" + rgb.map((v) => (v <= 0.0031308 ? 12.92 * v : 1.055 * v ** (1 / 2.4) - 0.055)).map((v) => Math.round(255 * Math.min(1, Math.max(0, v))).toString(16).padStart(2, "0")).join("");
