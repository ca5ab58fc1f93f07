// The document (what is saved), and what undo and redo go through. What EMPTY lacks, the server says.

export const EMPTY = { strokes: [], lights: [], regions: [], rotate_degrees: 0, tilt_degrees: 0, horizon_degrees: 0, exposure: 0, temperature: 0 };

export class History {
  constructor(changed) {
    this.changed = changed;
    this.begin(EMPTY);
  }

  // A document that was left earlier: its strokes can be taken back one by one.
  begin(document) {
    this.steps = document.strokes.map((_, i) => ({ ...document, strokes: document.strokes.slice(0, i) }));
    this.steps.push(document);
    this.at = this.steps.length - 1;
  }

  get document() { return this.steps[this.at]; }
  get undoable() { return this.at > 0; }
  get redoable() { return this.at < this.steps.length - 1; }

  // What changes nothing is no step: it ends what was shown.
  push(change) {
    const next = { ...this.document, ...change };
    if (JSON.stringify(next) === JSON.stringify(this.document)) { this.changed("done"); return; }
    this.steps.length = this.at + 1;
    this.steps.push(next);
    if (this.steps.length > 500) this.steps.shift();
    this.at = this.steps.length - 1;
    this.changed("done");
  }

  // What is being changed, by a pointer that is still down: shown, and no step of its own.
  preview(change, phase) { this.changed(phase, { ...this.document, ...change }); }

  go(i) {
    if (i === this.at || !this.steps[i]) return;
    this.at = i;
    this.changed("done");
  }

  undo() { if (this.undoable) { this.at--; this.changed("done"); } }
  redo() { if (this.redoable) { this.at++; this.changed("done"); } }

  // Another page has changed the document, or the server has refused the last change of it.
  follow(document, refused) {
    this.steps.length = refused ? this.at : this.at + 1;
    this.steps.push(document);
    this.at = this.steps.length - 1;
  }
}
