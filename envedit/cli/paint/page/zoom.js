// Zoom and pan of what a holder shows: wheel, middle button, two fingers, keys.

const MOST = 8;

export class Zoom {
  constructor(inner, changed = () => {}, pinched = () => {}) {
    Object.assign(this, { inner, changed, pinched, scale: 1, x: 0, y: 0, fingers: new Map() });
    const holder = inner.parentElement;
    holder.addEventListener("wheel", (e) => {
      if (e.defaultPrevented) return; // over a light
      e.preventDefault();
      this.by(1.2 ** -Math.sign(e.deltaY), e.clientX, e.clientY);
    }, { passive: false });
    holder.addEventListener("pointerdown", (e) => this.down(e), true);
    holder.addEventListener("pointermove", (e) => this.move(e), true);
    for (const end of ["pointerup", "pointercancel"]) holder.addEventListener(end, (e) => this.fingers.delete(e.pointerId), true);
  }

  // The point of the page that is given stays where it is; without one, the middle does.
  by(factor, x, y) {
    const box = this.inner.parentElement.getBoundingClientRect();
    const before = this.scale, [px, py] = [(x ?? box.x + box.width / 2) - box.x, (y ?? box.y + box.height / 2) - box.y];
    this.scale = Math.min(MOST, Math.max(1, before * factor));
    this.x = px - ((px - this.x) * this.scale) / before;
    this.y = py - ((py - this.y) * this.scale) / before;
    this.place();
  }

  reset() { this.scale = 1; this.place(); }

  place() {
    const { clientWidth, clientHeight } = this.inner;
    this.x = Math.min(0, Math.max(clientWidth * (1 - this.scale), this.x));
    this.y = Math.min(0, Math.max(clientHeight * (1 - this.scale), this.y));
    this.inner.style.transform = this.scale === 1 ? "" : `translate(${this.x}px, ${this.y}px) scale(${this.scale})`;
    this.inner.style.setProperty("--zoom", this.scale);
    this.changed();
  }

  down(event) {
    if (event.button !== 1 && event.pointerType !== "touch") return;
    this.fingers.set(event.pointerId, [event.clientX, event.clientY]);
    if (event.button === 1 || this.fingers.size > 1) { event.preventDefault(); event.stopPropagation(); }
    if (this.fingers.size === 2) this.pinched(); // the first finger was painting
  }

  move(event) {
    const from = this.fingers.get(event.pointerId), to = [event.clientX, event.clientY];
    if (!from) return;
    this.fingers.set(event.pointerId, to);
    if (event.pointerType === "touch" && this.fingers.size < 2) return; // one finger paints
    event.stopPropagation();
    const other = [...this.fingers].find(([id]) => id !== event.pointerId)?.[1];
    const share = other ? 0.5 : 1; // of two fingers, each moves by half
    this.x += share * (to[0] - from[0]);
    this.y += share * (to[1] - from[1]);
    const length = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
    if (other) this.by(length(to) / Math.max(1, length(from)), ...other);
    else this.place();
  }
}
