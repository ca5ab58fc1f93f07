// The page: what is sent when, and what is shown where.

import { Chooser } from "./chooser.js";
import { Compare } from "./compare.js";
import { Connection } from "./connection.js";
import { Display } from "./display.js";
import { $, button, slides } from "./elements.js";
import { EMPTY, History } from "./history.js";
import { Level } from "./level.js";
import { LightList } from "./light_list.js";
import { Lights, linear } from "./lights.js";
import { Regions } from "./regions.js";
import { Strokes } from "./strokes.js";
import { Zoom } from "./zoom.js";

const displays = {
  render: new Display($("render"), "radiance"),
  map: new Display($("map"), "radiance"),
  difference: new Display($("difference"), "signed"),
  unreachable: new Display($("unreachable"), "values"),
};
const WORDS = { saving: "Saving", moving: "Moving", solving: "Solving", rendering: "Rendering", done: "Done" };
const NAMES = { transport: "live", mitsuba: "path traced", saved: "saved" };
const log = []; // of edits and frames, for measurements
window.envedit = { log, advise };

// Tools that ask the server about a place of the rendering. Those with a sentence place a light by a click.
const PICKS = {
  move: ["highlight"], "move-shadow": ["shadow"], illuminate: ["illuminate", "illuminates this place"],
  rim: ["rim", "lights the rim from this place on"], cast: ["cast", "casts a shadow here"], shares: ["shares"],
};
const ORIENTATION = [["degrees", "rotate_degrees"], ["tilt", "tilt_degrees"], ["horizon", "horizon_degrees"]]; // numbers, and their keys
const LARGEST_LOOK = 1 << 18; // bytes; the server takes messages of four times that
const AMOUNTS = { light: [2, 0.6], shadow: [1, 0.6], contrast: [4, 1.6] }; // largest, and what is chosen
const frames = { render: [], map: [], difference: [], unreachable: [], before: [], photograph: [], explanation: [] }; // the last of each view

let view = 0, views = [], outlined = false;
let thumbDue = false; // the picture of the present step is taken when it is drawn next
let client = "", painting = 0, sent = 0, unedited = 0, since = null, opened = false, last = {}, waiting = null, tool = "shadow", shape = "brush";

// ---- the document

const history = new History((phase, document) => {
  send(document ?? history.document, phase);
  if (phase !== "done") return;
  lights.solo = -1;
  refresh();
});

const compare = new Compare(frames, displays, history, { view: () => view, send: (message) => connection.send(message) });
const redraw = () => strokes.draw();
const zooms = [new Zoom($("render").parentElement, redraw, () => strokes.cancel()), new Zoom($("map-stack"), redraw, () => regions.cancel())];

function send(document, phase) {
  waiting = { document, phase };
  since ??= performance.now();
  if (phase === "done") flush();
  else if (!send.due) {
    send.due = true;
    requestAnimationFrame(() => { send.due = false; flush(); });
  }
}

function flush() {
  if (!waiting || !opened) return;
  const message = { type: "document", number: ++sent, painting, ...waiting };
  if (!connection.send(message)) return; // sent again when the server is back
  note({ edit: sent, phase: waiting.phase, since });
  const { classList } = $("message");
  if (waiting.phase === "done" && (classList.contains("saved") || !classList.contains("good"))) say(""); // it was of what is past
  since = null;
  waiting = null;
}

function note(entry) {
  log.push({ at: performance.now(), ...entry });
  if (log.length > 5000) log.splice(0, 1000);
}

// ---- from the server

const connection = new Connection({
  lost() { state("error", "The server cannot be reached; trying again (one that was started anew has another address: see the terminal)"); },
  frame(frame) {
    if (frames[frame.kind]) frames[frame.kind][frame.view] = frame;
    if (frame.kind === "explanation") explanations[frame.view]?.show(frame);
    else if (frame.kind.startsWith("sky")) compare.sky(frame);
    else if (frame.view === view || frame.kind === "map") show(frame);
  },
  message(message) { RECEIVED[message.type]?.(message); },
});

function show(frame) {
  if (frame.kind === "before") { compare.show(); return; }
  if (frame.kind === "photograph") { compare.photograph(); return; }
  if (frame.kind === "render") {
    $("render-stack").parentElement.style.setProperty("--aspect", frame.width / frame.height);
    $("badge").textContent = NAMES[frame.source];
  }
  if (frame.kind === "unreachable") $("unreachable").parentElement.hidden = !history.document.strokes.length;
  if (frame.kind !== "map") displays[frame.kind].canvas.style.setProperty("aspect-ratio", frame.width / frame.height);
  displays[frame.kind].show(frame);
}

// ---- explanations of the paint, of which one is shown

let explanations = []; // their displays
function explain(message) {
  $("explanations").hidden = !message.explanations.length;
  if (!message.explanations.length) frames.explanation = [];
  explanations = message.explanations.map(() => new Display(document.createElement("canvas"), "radiance"));
  $("explanations").replaceChildren(...message.explanations.map(({ name, reached }, i) => {
    const act = () => connection.send({ type: "choose", explanation: i });
    const chosen = button(`explanation-${i}`, explanations[i].canvas, { ariaPressed: String(i === message.chosen) }, act);
    chosen.append(`${name}: ${percent(reached)}`);
    explanations[i].set({ stops: Number($("exposure").value), curve: Number($("tonemap").value) });
    if (frames.explanation[i]) explanations[i].show(frames.explanation[i]);
    return chosen;
  }));
}

// ---- views of the scene, one at a time

function tabs(names) {
  views = names;
  view = Math.min(view, names.length - 1);
  $("views").hidden = names.length < 2;
  $("views").replaceChildren(...names.map((name, i) => {
    const tab = button(`view-${i}`, name, { role: "tab" }, () => chooseView(i));
    tab.setAttribute("aria-controls", "render-stack");
    tab.addEventListener("keydown", (event) => {
      const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
      if (!step) return;
      chooseView((i + step + names.length) % names.length);
      $("views").children[view].focus();
      event.preventDefault();
    });
    return tab;
  }));
  chooseView(view);
}

function chooseView(i) {
  if (i !== view && (strokes.drawing || strokes.corners)) strokes.cancel();
  view = i;
  [...$("views").children].forEach((tab, k) => {
    tab.ariaSelected = String(k === i);
    tab.tabIndex = k === i ? 0 : -1;
  });
  for (const kind of ["before", "render", "difference", "unreachable"]) if (frames[kind][i]) show(frames[kind][i]);
  strokes.draw();
}

displays.render.drawn = (frame) => {
  if (thumbDue) { thumbDue = false; compare.take(); }
  $("status").dataset.frame = frame.number;
  $("status").dataset.source = frame.source;
  note({ frame: frame.number, source: frame.source });
};

const RECEIVED = {
  hello(message) { client = message.client; },
  start(message) {
    if (opened) return;
    $("start").hidden = false;
    chooser.offer(message);
    $("names").replaceChildren(...message.scenes.concat(message.configurations).map((name) => Object.assign(document.createElement("option"), { value: name })));
    state("ready", "Choose what to paint on");
  },
  opened(message) {
    $("start").hidden = true;
    $("work").hidden = false;
    for (const group of document.querySelectorAll("header .group")) group.hidden = false;
    $("title").textContent = $("title").title = message.title;
    document.title = `${message.title} · envedit paint`;
    tabs(message.views);
    const mine = opened && waiting; // made while the server was away
    if (!opened || JSON.stringify(message.document) !== JSON.stringify(history.document)) {
      if (!mine) history.begin({ ...EMPTY, ...message.document });
    }
    if (!opened || painting !== message.painting) {
      $("exposure").value = message.exposure;
      look({ stops: message.exposure });
      compare.forget();
    }
    $("rest").disabled = message.hold !== "auto";
    $("rest").title = $("rest").disabled ? `[target] hold = ${message.hold} is given` : "";
    listed.white = message.white;
    opened = true;
    painting = message.painting;
    unedited = sent; // the number of what is open
    if (mine) flush();
    say(message.again && !message.notes.length ? `Goes on from painted.toml of ${message.folder}` : message.notes.join("; "), true);
    refresh();
  },
  thumbnail(message) { if (!opened) chooser.picture(message); },
  document(message) {
    lights.solo = -1;
    if ($("message").classList.contains("saved")) say("");
    history.follow({ ...EMPTY, ...message.document }, !message.client);
    refresh();
  },
  lights(message) { lights.set(message); },
  explanations(message) { explain(message); },
  status(message) {
    last = message;
    $("unreachable").classList.toggle("stale", message.reachable == null);
    $("progress").hidden = message.state !== "loading" && message.state !== "saving";
    advise(message.advice ?? null);
    if (message.state === "rendering" || message.state === "done") {
      thumbDue = true;
      displays.render.draw();
    }
    if (message.state === "done") compare.again();
    if (message.client === client && message.number) note({ status: message.number, of: message.frame, state: message.state, steps: message.steps });
    state(message.state, message.text ?? told(message));
  },
  doing(message) { $("status").textContent = `${told(last)} · ${message.text}`; },
  progress(message) {
    $("progress").hidden = false;
    $("progress").max = Math.max(1, message.total);
    $("progress").value = message.done;
  },
  saving(message) { state("saving", `Saving: ${message.text}`); },
  saved(message) {
    say("", true);
    $("progress").hidden = true;
    const links = message.files.filter((name) => ["report.html", "edited.exr", "edited_full.exr", "edited_full.hdr", "lights.json", "look.toml"].includes(name));
    $("message").classList.add("saved");
    const older = { [client]: message.number, "": unedited }[message.client] < sent; // of another page's: false
    $("message").replaceChildren(`Saved in ${message.folder}${older ? ", without what was changed meanwhile" : ""}: `, ...links.flatMap((name) => [Object.assign(document.createElement("a"), { href: `result/${name}`, textContent: name, target: "_blank" }), " "]), ...[...message.notes, ...message.warnings].map((line) => `${line}. `));
  },
  note(message) { say(message.text, true); },
  refused(message) { say(message.text); },
  error(message) { $("progress").hidden = true; say(message.text); state("error", "Error"); },
};

function told(message) {
  const parts = [];
  if (message.reached != null) {
    const feasible = message.reachable == null ? "" : `, ${percent(message.reachable)} feasible`;
    parts.push(`${percent(message.reached)} of the paint reached${feasible}`);
  }
  parts.push(WORDS[message.state]);
  if (message.samples) parts.push(`path traced with ${message.samples} samples a pixel`);
  $("technical").textContent = `${message.iterations} iterations · ${Math.round(message.ms ?? 0)} ms`
    + (message.hold ? ` · target.hold = ${+message.hold.toPrecision(3)}` : "");
  return parts.join(" · ");
}

function percent(share) { return `${Math.round(100 * share)} %`; }

// Which strokes are missed and why, with a button for each thing that reaches more.
function advise(advice) {
  $("advice").hidden = !advice;
  $("advice-text").textContent = advice?.text ?? "";
  $("advice-do").replaceChildren(...(advice?.actions ?? []).map(({ label, change }, i) => button(`advice-${i}`, label, { title: "Ctrl+Z takes it back" }, () => {
    advise(null);
    history.push(change);
  })));
}

function state(name, text) {
  const status = $("status");
  status.textContent = text;
  if (status.dataset.state !== name) $("live").textContent = text;
  status.dataset.state = name;
  document.querySelector(".group").toggleAttribute("inert", name === "saving");
}

function say(text, good = false) {
  $("message").textContent = text ?? "";
  $("message").className = good ? "good" : "";
}

// ---- painting

const strokes = new Strokes($("overlay"), () => ({
  type: tool,
  picks: PICKS[tool],
  shape,
  size: Number($("size").value),
  softness: Number($("softness").value),
  opacity: Number($("opacity").value),
  amount: tool === "light" ? brought($("amount").value) : Number($("amount").value),
  color: linear($("color").value).map((v) => Math.round(v * 1e4) / 1e4),
  kelvin: Number($("kelvin").value),
  radius: Number($("radius").value),
  view,
  outlined: outlined ? history.document.strokes.filter((one) => viewed(one) === view && one.units !== "pixels") : [],
}), {
  preview(stroke) { history.preview({ strokes: [...history.document.strokes, stroke] }, "drawing"); },
  done(stroke) { history.push({ strokes: [...history.document.strokes, stroke] }); },
  cancel() { dropped = answered = asked; clearTimeout(unanswered); send(history.document, "done"); refresh(); },
  drag(phase, x, y, event) { pick(phase, x, y, event); },
});

// Radiance of a light stroke, whose amount is of what is shown as white.
function brought(amount) { return Number((amount / 2 ** displays.render.settings.stops).toPrecision(4)); }

// Strokes name their view by its index, or by the id of its sensor.
function viewed(stroke) {
  const named = views.indexOf(stroke.view);
  return named < 0 ? stroke.view ?? 0 : named;
}

// A highlight or a shadow is dragged: first ask whose it is, then where that light must go. A drag is one step of
// history: it ends with the answer to the last question, or after UNANSWERED where none comes.
const UNANSWERED = 5000;
let dragged = tool, picked = -1, point, place = null, asked = 0, answered = 0, dropped = 0, ended = false, unanswered = 0, held = null;
function pick(phase, x, y, event) {
  if (phase === "start") dragged = tool; // another may be chosen before all is answered
  const placing = PICKS[dragged][1];
  if (phase === "start") {
    clearTimeout(unanswered);
    picked = placing && lights.list()[lights.chosen] ? lights.chosen : -1;
    point = undefined;
    place = held = null;
    ended = false;
  }
  if (phase === "move" && (event?.shiftKey || event?.ctrlKey)) { // flux or size of the light in place of where it is
    if (picked < 0) return;
    held ??= { light: lights.list()[picked], y: event.clientY };
    lights.stretch(picked, held.light, held.y - event.clientY, event.ctrlKey);
    return;
  }
  if (phase === "end") {
    ended = true;
    if (answered === asked) lights.commit();
    else unanswered = setTimeout(() => lights.commit(), UNANSWERED);
    return;
  }
  if (phase === "move") place = [x, y];
  if (phase === "move" && picked < 0 && !placing) return; // asked once it is known whose it is
  ask(x, y);
}
function ask(x, y) {
  connection.send({ type: "pick", of: PICKS[dragged][0], point, x, y, light: picked, view, number: ++asked });
}
RECEIVED.picked = (message) => {
  if (message.client !== client || message.number <= dropped) return; // of a drag that was given up
  answered = message.number;
  if (message.shares) {
    if (message.light >= 0) lights.choose(message.light);
    say(madeBy(message.shares), true);
  } else if (message.text) say(`Light not moved: ${message.text}`);
  else if (message.azimuth === undefined) {
    picked = message.light;
    point = message.point;
    if (picked < 0) say("No light of the map lights this pixel: add one, or paint");
    else {
      lights.choose(picked);
      if (place) ask(...place);
    }
  } else {
    picked = message.light;
    lights.place(picked, message);
    const does = PICKS[dragged][1];
    say(does && `Light ${lights.chosen + 1} ${does}: azimuth ${Math.round(message.azimuth)}, elevation ${Math.round(message.elevation)} degrees`, true);
  }
  if (!ended || answered !== asked) return;
  clearTimeout(unanswered); // what is dragged meanwhile by its handle is not at its end
  lights.commit();
};

// Whose light a pixel shows, in words: lights that give 1 % of it or more, and the rest of the map.
function madeBy(shares) {
  const listed = lights.list();
  const named = (i) => i < 0 ? "a light added by paint" : `light ${i + 1}${listed[i]?.entry.name ? ` (${listed[i].entry.name})` : ""}`;
  const parts = shares.filter(([, share]) => share >= 0.01).sort((a, b) => b[1] - a[1]);
  const rest = 1 - parts.reduce((sum, [, share]) => sum + share, 0);
  return `Light of this place: ${[...parts.map(([i, share]) => `${percent(share)} by ${named(i)}`), `${percent(Math.max(0, rest))} by the rest of the map`].join(", ")}`;
}

// What changes the map by a pointer: shown while it is down, and a step of the history afterwards.
const edits = {
  document: () => history.document,
  preview: (change) => history.preview(change, "dragging"),
  done: (change) => history.push(change),
};
const lights = new Lights({ ...edits, back: () => send(history.document, "done"), drawn: (all) => listed.draw(all) });
const listed = new LightList($("light-list"), lights);
const level = new Level({
  ...edits,
  preview(change) {
    lights.draft = { ...history.document, ...change };
    edits.preview(change);
    lights.draw();
    level.draw(lights.draft);
    orient(lights.draft);
  },
});
const regions = new Regions(edits);

// ---- controls

function refresh() {
  const now = history.document;
  $("undo").disabled = !history.undoable;
  $("redo").disabled = !history.redoable;
  $("clear").disabled = Object.keys(EMPTY).every((key) => JSON.stringify(now[key]) === JSON.stringify(EMPTY[key]));
  if (!now.strokes.length) { // nothing is asked for that might not be feasible
    frames.unreachable = [];
    $("unreachable").parentElement.hidden = true;
  }
  orient(now);
  $("map-exposure").value = now.exposure;
  $("map-temperature").value = now.temperature;
  $("map-exposure-slide").value = now.exposure;
  $("map-temperature-slide").value = now.temperature || 6500;
  $("rest").value = now.rest ?? "follow";
  $("freedom").value = now.freedom ?? 0;
  valued($("freedom"));
  lights.drop();
  lights.draw();
  level.draw();
  regions.draw();
  strokes.draw();
  compare.draw();
}

function orient(document) {
  for (const [id, key] of ORIENTATION) $(id).value = document[key];
}

function choose(name, value) {
  if (name === "tool") tool = value;
  else shape = value;
  for (const button of document.querySelectorAll(`[data-${name}]`)) button.ariaPressed = String(button.dataset[name] === value);
  for (const label of document.querySelectorAll("[data-for]")) {
    const wanted = label.dataset.for.split(" ");
    label.hidden = wanted[0] === "size" ? shape !== "brush" && shape !== "line" : !wanted.includes(tool);
  }
  if (AMOUNTS[tool]) [$("amount").max, $("amount").value] = AMOUNTS[tool];
  valued($("amount"));
  $("shapes").hidden = $("options").hidden = Boolean(PICKS[tool]);
  strokes.reset();
  strokes.draw();
}

// Write what a slider is set to beside it.
function valued(input) {
  const value = Number(input.value), unit = input.dataset.unit;
  const output = input.parentElement.querySelector(".value");
  output.textContent = unit === "%" ? `${+(100 * value).toFixed(1)} %` : unit ? `${value} ${unit}` : value;
}
for (const input of document.querySelectorAll("#options input[type=range]")) {
  input.addEventListener("input", () => valued(input));
  valued(input);
}
$("rest").addEventListener("change", () => history.push({ rest: $("rest").value }));
slides($("freedom"), () => {
  valued($("freedom"));
  history.preview({ freedom: Number($("freedom").value) }, "drawing");
}, () => history.push({ freedom: Number($("freedom").value) }));
$("amount").addEventListener("input", () => { AMOUNTS[tool][1] = Number($("amount").value); });

for (const button of document.querySelectorAll("[data-tool]")) button.addEventListener("click", () => choose("tool", button.dataset.tool));
for (const button of document.querySelectorAll("[data-shape]")) button.addEventListener("click", () => choose("shape", button.dataset.shape));
$("undo").addEventListener("click", () => history.undo());
$("redo").addEventListener("click", () => history.redo());
$("clear").addEventListener("click", () => history.push(EMPTY));
$("save").addEventListener("click", save);
$("add").addEventListener("click", () => lights.add());
$("region").addEventListener("click", () => { if (regions.active && lights.turning) $("turn").click(); });
$("turn").addEventListener("click", () => {
  lights.turning = !lights.turning;
  if (lights.turning && regions.active) regions.toggle();
  $("turn").ariaPressed = String(lights.turning);
  $("handles").classList.toggle("turning", lights.turning);
});
$("exposure").addEventListener("input", () => look({ stops: Number($("exposure").value) }));
$("tonemap").addEventListener("change", () => look({ curve: Number($("tonemap").value) }));
$("split").addEventListener("input", () => displays.render.set({ split: Number($("split").value) }));
$("size").addEventListener("input", () => strokes.draw());
$("outlines").addEventListener("click", outline);
$("help").addEventListener("click", () => $("keys").showModal());
$("keys-close").addEventListener("click", () => $("keys").close());
for (const [id, key] of [...ORIENTATION, ["map-exposure", "exposure"], ["map-temperature", "temperature"]]) {
  $(id).addEventListener("change", () => {
    const value = Number($(id).value);
    if (!$(id).checkValidity() || !Number.isFinite(value) || (key === "temperature" && value && value < 2000)) {
      say(`${$(id).closest("label").textContent.trim()}: ${key === "temperature" ? "0, or 2000 to 25000 kelvin" : `${$(id).min} to ${$(id).max}`}`);
      refresh();
    } else history.push({ [key]: value });
  });
}

async function put(kind, file) {
  try {
    const answer = await fetch(`${kind}/${encodeURIComponent(file.name)}`, { method: "PUT", body: file });
    return [answer.ok, await answer.text()];
  } catch { // the server has gone, or hangs up on a file that is too large
    return [false, `${file.name} was not taken: the server cannot be reached, or the file is too large`];
  }
}
// A button that asks for a file.
function asksFor(id, act) {
  const input = $(`${id}-file`);
  $(id).addEventListener("click", () => input.click());
  input.addEventListener("change", () => {
    const [file] = input.files;
    input.value = ""; // the same file may be chosen again
    if (file) act(file);
  });
}
asksFor("light-image", async (file) => {
  const index = lights.chosen, [taken, text] = await put("image", file);
  if (taken) lights.edit(index, { shape: "image", image: text, aspect: undefined });
  else say(text);
});
asksFor("look", async (file) => {
  if (file.size > LARGEST_LOOK) { say(`${file.name} is no look: ${file.size} bytes`); return; }
  say("");
  connection.send({ type: "look", name: file.name, text: await file.text() });
});

// The sliders of the whole map: 6500 K changes nothing.
for (const [id, key, nothing] of [["map-exposure", "exposure", 0], ["map-temperature", "temperature", 6500]]) {
  const slide = $(`${id}-slide`), change = () => ({ [key]: Number(slide.value) === nothing ? 0 : Number(slide.value) });
  slides(slide, () => { $(id).value = change()[key]; history.preview(change(), "drawing"); }, () => history.push(change()));
}

function outline() {
  outlined = !outlined;
  $("outlines").ariaPressed = String(outlined);
  strokes.draw();
}

function look(changed) {
  $("exposure-value").textContent = $("exposure").value;
  for (const one of [displays.render, displays.map, displays.sky, ...explanations]) one.set(changed);
}

function save() {
  if (!opened || $("status").dataset.state === "saving") return;
  say("");
  if (lights.solo >= 0) lights.hear(lights.solo); // nothing is kept of it
  if (connection.send({ type: "save" })) state("saving", "Saving");
}

window.addEventListener("keydown", (event) => {
  if (!opened || $("keys").open || $("sky-dialog").open) return;
  const key = event.key.toLowerCase(), saves = key === "s" && (event.ctrlKey || event.metaKey), lettered = [...document.querySelectorAll("[data-key]")].find((button) => button.dataset.key === key);
  if (event.target.matches("input:not([type=range], [type=color]), select")) { // is typed into
    if (!saves) return;
    event.target.blur(); // what was typed is saved
  }
  if (event.ctrlKey || event.metaKey) {
    if (key === "z" && !event.shiftKey) history.undo();
    else if (key === "y" || key === "z") history.redo();
    else if (saves) save();
    else return;
  } else if (key === "b" && !event.repeat) displays.render.set({ split: 1 });
  else if (key === "o" && !event.repeat) outline();
  else if (key === "m") compare.large();
  else if (key === "l") $("level").click();
  else if (key === "g") $("region").click();
  else if (key === "a") compare.keep();
  else if (key === "h") compare.toggle();
  else if (key === "+" || key === "-") zooms[0].by(key === "+" ? 1.2 : 1 / 1.2);
  else if (key === "0") for (const zoom of zooms) zoom.reset();
  else if (key === "[" || key === "]") {
    $("size")[key === "[" ? "stepDown" : "stepUp"]();
    valued($("size"));
    strokes.draw();
  }
  else if (key === "escape") lights.choose(-1);
  else if (lettered) choose("tool", lettered.dataset.tool);
  else if (/^[1-9]$/.test(key)) choose("tool", document.querySelectorAll("[data-tool]")[key - 1].dataset.tool);
  else return;
  event.preventDefault();
});
const release = () => displays.render.set({ split: Number($("split").value) });
window.addEventListener("keyup", (event) => { if (event.key.toLowerCase() === "b") release(); });
window.addEventListener("blur", release); // another window has the key that is released
window.addEventListener("resize", () => strokes.draw());

// ---- start page

const chooser = new Chooser($("open-map"), open);
function open(name, envmap = $("open-map").value.trim()) {
  say("");
  state("loading", `Opening ${name}`);
  connection.send({ type: "open", name, envmap });
}
$("open-form").addEventListener("submit", (event) => { event.preventDefault(); open($("open-name").value.trim()); });

async function upload(file) {
  state("loading", `Taking ${file.name}`);
  const [taken, text] = await put("map", file);
  if (!taken) { say(text); state("ready", "Choose what to paint on"); return; }
  chooser.choose(text);
  $("open-name").value ||= "sphere";
  state("ready", "Choose what to paint on");
}
$("drop").addEventListener("click", () => $("file").click());
$("drop").addEventListener("keydown", (event) => { if (event.key === "Enter" || event.key === " ") $("file").click(); });
$("file").addEventListener("change", () => { if ($("file").files[0]) upload($("file").files[0]); });
$("drop").addEventListener("dragover", (event) => { event.preventDefault(); $("drop").classList.add("over"); });
$("drop").addEventListener("dragleave", () => $("drop").classList.remove("over"));
// A file that is dropped anywhere; the browser would show it in place of the page.
window.addEventListener("dragover", (event) => event.preventDefault());
window.addEventListener("drop", (event) => {
  event.preventDefault();
  $("drop").classList.remove("over");
  const [file] = event.dataTransfer.files;
  if (opened && file) say(`${file.name} was not taken: another map is chosen where \`envedit paint\` starts without a scene`);
  else if (file) upload(file);
});

choose("tool", "shadow");
choose("shape", "brush");
refresh();
