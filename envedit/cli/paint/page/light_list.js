// All lights in a table: name, role, flux in stops, radius in degrees, kelvin; solo, mute, lock. A click chooses one.

import { button } from "./elements.js";
import { degrees, flux, luminance, off, signed, stops } from "./lights.js";

const COLUMNS = ["", "Name", "Role", "Stops", "Radius °", "Kelvin", ""];
const SWITCHES = [
  ["solo", "S", "Show this light alone, until the next edit"],
  ["mute", "M", "Switch off"],
  ["lock", "L", "The paint leaves this light as it is"],
];
const ROLES = ["", "key", "fill", "rim"]; // as in config/light_schema.py

export class LightList {
  constructor(holder, lights) {
    Object.assign(this, { holder, lights, rows: [], white: [] });
  }

  draw(list) {
    if (this.rows.length !== list.length) {
      this.rows = list.map((_, i) => this.row(i));
      const head = COLUMNS.map((text) => Object.assign(document.createElement("span"), { textContent: text }));
      this.holder.replaceChildren(...(list.length ? head : []), ...this.rows.flatMap((row) => row.cells));
    }
    list.forEach((light, i) => this.fill(this.rows[i], light, i));
  }

  row(i) {
    const cell = (name, text, title, act) => button(`list-${name}-${i + 1}`, text, { title, ariaLabel: `${name} light ${i + 1}` }, act);
    const control = (name, made, attributes) => {
      Object.assign(made, { id: `list-${name}-${i + 1}`, ariaLabel: `${name} of light ${i + 1}`, ...attributes });
      made.addEventListener("focus", () => this.lights.choose(i));
      return made;
    };
    const input = (name, attributes, change) => {
      const made = control(name, document.createElement("input"), attributes);
      made.addEventListener("change", () => {
        const light = this.lights.list()[i], usable = made.checkValidity() && (made.type === "text" || made.value !== "");
        if (usable) this.lights.edit(i, change(light, made.value));
        else made.value = made.defaultValue; // what was there before
      });
      return made;
    };
    const chosen = cell("choose", i + 1, "Choose its handle on the map", () => this.lights.choose(i));
    const role = control("role", document.createElement("select"), {});
    role.append(...ROLES.map((value) => new Option(value || "–", value)));
    role.addEventListener("change", () => this.lights.edit(i, { role: role.value || undefined }));
    const name = input("name", { type: "text", maxLength: 60 }, (_, value) => ({ name: value.trim() || undefined }));
    const stop = input("stops", { type: "number", min: -20, max: 20, step: 0.1 }, (light, value) => ({ flux: limited(light.entry.flux.map((v) => v * 2 ** (value - stops(light, this.lights.unit)))) }));
    const size = input("radius", { type: "number", min: 0.01, max: 90, step: "any" }, (light, value) => ({ size: Math.max(0.01, light.own ? Math.min(20, value / light.own.radius) : Number(value)) }));
    const kelvin = input("kelvin", { type: "number", min: 2000, max: 25000, step: "any" }, (light, value) => this.coloured(light, Number(value)));
    const switches = Object.fromEntries(SWITCHES.map(([key, text, title]) => [key, cell(key, text, title, () => this.press(key, i))]));
    const group = document.createElement("span");
    group.append(...Object.values(switches));
    return { cells: [chosen, name, role, stop, size, kelvin, group], chosen, name, role, stop, size, kelvin, switches };
  }

  press(key, i) {
    if (key === "solo") this.lights.hear(i);
    else if (key === "mute") this.lights.mute(i);
    else this.lights.edit(i, { locked: !this.lights.list()[i].entry.locked || undefined });
  }

  // What is being typed stays.
  fill(row, light, i) {
    const write = (input, text) => {
      if (input !== document.activeElement) input.value = text;
      input.defaultValue = text;
    };
    const value = stops(light, this.lights.unit), kelvin = this.kelvin(flux(light));
    row.chosen.ariaPressed = String(i === this.lights.chosen);
    write(row.name, light.entry.name ?? "");
    row.name.placeholder = light.own ? `light ${i + 1}` : "added";
    row.role.value = light.entry.role ?? "";
    write(row.stop, Number.isFinite(value) ? signed(value).replace("−", "-").replace("+", "") : "");
    write(row.size, String(+degrees(light).toPrecision(3)));
    write(row.kelvin, kelvin ? String(Math.round(kelvin / 10) * 10) : "");
    row.switches.solo.ariaPressed = String(i === this.lights.solo);
    row.switches.mute.ariaPressed = String(Boolean(off(light)));
    row.switches.lock.ariaPressed = String(Boolean(light.entry.locked));
  }

  // The flux of a light in the colour of a black body, at the same luminance.
  coloured(light, kelvin) {
    const i = Math.max(1, this.white.findIndex(([k]) => k <= kelvin)), [[above, ...hot], [below, ...cold]] = [this.white[i - 1], this.white[i]];
    const t = (1 / kelvin - 1 / above) / (1 / below - 1 / above), most = luminance(flux(light));
    const color = hot.map((v, c) => (v + t * (cold[c] - v)) * most);
    return { flux: limited(color.map((v, c) => v / (light.own ? Math.max(light.own.flux[c], 1e-9) : 1))) };
  }

  // Kelvin of the black body whose red and blue over green are nearest, 0 for black.
  kelvin(color) {
    if (!(Math.min(...color) > 0) || !this.white.length) return 0;
    const ratios = ([r, g, b]) => [Math.log(r / g), Math.log(b / g)];
    const [x, y] = ratios(color), nodes = this.white.map(([k, ...c]) => [1 / k, ...ratios(c)]);
    let best = [Infinity, 0];
    for (let i = 1; i < nodes.length; i++) {
      const [[m0, x0, y0], [m1, x1, y1]] = [nodes[i - 1], nodes[i]], [dx, dy] = [x1 - x0, y1 - y0];
      const t = Math.min(1, Math.max(0, ((x - x0) * dx + (y - y0) * dy) / (dx * dx + dy * dy)));
      const far = Math.hypot(x - x0 - t * dx, y - y0 - t * dy);
      if (far < best[0]) best = [far, 1 / (m0 + t * (m1 - m0))];
    }
    return best[1];
  }
}

const limited = (flux) => flux.map((v) => Math.min(1e6, v));
