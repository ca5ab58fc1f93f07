// What is compared: the rendering with the original or with a state A, the map large with the original, all steps.

import { Display } from "./display.js";
import { $, button } from "./elements.js";
import { Zoom } from "./zoom.js";

const SHOWN_STEPS = 60;
const THUMB = 48; // pixels high
const NAMES = { strokes: "strokes", lights: "lights", regions: "regions of the map", rotate_degrees: "turn of the sky", tilt_degrees: "tilt", horizon_degrees: "horizon", exposure: "map exposure", temperature: "map temperature", rest: "the rest", freedom: "the sky may change" };

export class Compare {
  constructor(frames, displays, history, on) {
    Object.assign(this, { frames, displays, history, on, kept: null, thumbs: new WeakMap(), drawn: [] }); // on: view(), send(message)
    displays.sky = new Display($("sky"), "radiance");
    this.zoom = new Zoom($("sky").parentElement);
    $("keep-a").addEventListener("click", () => this.keep());
    $("back-a").addEventListener("click", () => history.push(this.kept.document));
    $("reference").addEventListener("change", () => this.show());
    $("past").addEventListener("click", () => this.toggle());
    $("large").addEventListener("click", () => this.large());
    $("sky-close").addEventListener("click", () => $("sky-dialog").close());
    $("sky-split").addEventListener("input", () => displays.sky.set({ split: Number($("sky-split").value) }));
  }

  // ---- a state A

  keep() {
    this.kept = { document: this.history.document, render: [...this.frames.render] };
    $("reference").options[1].disabled = $("back-a").disabled = false;
    $("reference").value = "1";
    this.show();
  }

  // Another painting is open: there is no state A of it, and perhaps no photograph.
  forget() {
    this.kept = null;
    this.frames.photograph = [];
    for (const option of [...$("reference").options].slice(1)) option.disabled = true;
    $("back-a").disabled = true;
    $("reference").value = "0";
  }

  // The photograph has come: it is what the rendering is compared with at first.
  photograph() {
    const option = $("reference").options[2];
    if (option.disabled) $("reference").value = "2";
    option.disabled = false;
    this.show();
  }

  // The picture that is shown before, of the present view.
  show() {
    const pictures = [this.frames.before, this.kept?.render, this.frames.photograph];
    const frame = pictures[Number($("reference").value)][this.on.view()];
    if (frame) this.displays.render.compare(frame);
  }

  // ---- the map, large

  large() {
    $("sky-size").textContent = "";
    this.displays.sky.show(this.frames.map[0]);
    $("sky-dialog").showModal();
    this.zoom.reset();
    this.on.send({ type: "sky" });
  }

  sky(frame) {
    if (frame.kind === "sky-before") { this.displays.sky.compare(frame); return; }
    this.displays.sky.show(frame);
    $("sky-size").textContent = `${frame.width} x ${frame.height} texels`;
  }

  // The solution has gone on: what is shown large is of before.
  again() { if ($("sky-dialog").open) this.on.send({ type: "sky" }); }

  // ---- the history in pictures

  toggle() {
    const open = $("steps").hidden;
    $("steps").hidden = !open;
    $("past").ariaExpanded = String(open);
    this.draw();
  }

  // Keep what the canvas shows now as the picture of the present step.
  take() {
    const canvas = $("render"), thumb = document.createElement("canvas");
    Object.assign(thumb, { height: THUMB, width: Math.max(1, Math.round((THUMB * canvas.width) / canvas.height)) });
    thumb.getContext("2d").drawImage(canvas, 0, 0, thumb.width, thumb.height);
    this.thumbs.set(this.history.document, thumb);
    this.draw();
  }

  draw() {
    if ($("steps").hidden) return;
    const { steps, at } = this.history, first = Math.max(0, steps.length - SHOWN_STEPS), shown = steps.slice(first);
    // Buttons stay while their steps do: a click on one that is replaced meanwhile would be lost.
    if (shown.length !== this.drawn.length || shown.some((step, k) => step !== this.drawn[k])) {
      $("steps").replaceChildren(...shown.map((step, k) => this.button(step, first + k)));
      this.drawn = shown;
    }
    shown.forEach((step, k) => {
      const shownStep = $("steps").children[k];
      shownStep.ariaPressed = String(first + k === at);
      shownStep.replaceChildren(this.thumbs.get(step) ?? String(first + k));
    });
    $("steps").children[at - first]?.scrollIntoView({ block: "nearest", inline: "nearest" });
  }

  button(step, i) {
    const title = i ? changed(this.history.steps[i - 1], step) : "the beginning";
    return button(`step-${i}`, "", { title, ariaLabel: `Step ${i}: ${title}` }, () => this.history.go(i));
  }
}

function changed(before, after) {
  if (after.strokes.length === before.strokes.length + 1) return `stroke: ${after.strokes.at(-1).type}`;
  const keys = Object.keys(NAMES).filter((key) => JSON.stringify(before[key]) !== JSON.stringify(after[key]));
  return keys.map((key) => NAMES[key]).join(", ") || "names";
}
