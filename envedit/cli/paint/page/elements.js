// What the modules of the page share: elements by their id, buttons, the steps of arrow keys, pointers that drag.

export const $ = (id) => document.getElementById(id);

export const clamp = (value, least, most) => Math.max(least, Math.min(most, value));

// To the right, and upwards.
export const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

export function button(id, content, attributes, act = () => {}) {
  const made = Object.assign(document.createElement("button"), { id, ...attributes });
  made.append(content);
  made.addEventListener("click", act);
  return made;
}

export function consume(event) {
  event.preventDefault();
  event.stopPropagation();
}

// An input says "change" only where it ends elsewhere than it began: it ends as well with the pointer, or the focus.
export function slides(input, moved, ended) {
  let due = false;
  input.addEventListener("input", () => { due = true; moved(); });
  for (const end of ["change", "pointerup", "blur"]) input.addEventListener(end, () => {
    if (due) ended();
    due = false;
  });
}

// Follow the pointer that has pressed an element until it is released.
export function follow(element, event, move, end, cancel = end) {
  element.setPointerCapture(event.pointerId);
  const over = (act) => () => {
    element.onpointermove = element.onpointerup = element.onpointercancel = null;
    act();
  };
  Object.assign(element, { onpointermove: move, onpointerup: over(end), onpointercancel: over(cancel) });
}
