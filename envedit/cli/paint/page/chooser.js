// The start page: maps to choose, and scenes, examples and earlier paintings to open, with small pictures.

import { $ } from "./elements.js";

export class Chooser {
  constructor(map, open) {
    Object.assign(this, { map, open, pictures: new Map() }); // of files: base 64, or null for one that is no map
    map.addEventListener("input", () => this.mark());
  }

  offer({ maps, scenes, configurations, recent }) {
    const made = [["", "the scene's own"], ["sunsky", "analytic sky", "map-sunsky.jpg"]];
    this.list("maps", [...made, ...maps.map((file) => [file, file, null, file])], (file) => this.choose(file));
    this.list("shipped", scenes.map((name) => [name, name, `scene-${name}.jpg`]), (name) => this.open(name));
    this.list("edits", configurations.map((name) => {
      const short = name.replace(/.*\//, "");
      return [name, short.replaceAll("_", " "), `edit-${short}.jpg`];
    }), (name) => this.open(name));
    this.list("recent", recent.map(({ path, title, picture }) => [path, `${title}, in ${path.split(/[\\/]/).slice(-3, -1).join("/")}`, null, picture]), (path) => this.open(path, ""));
    this.mark();
  }

  // Tiles of a list, each of what it stands for, its text, its picture (an address), or the file that one is made of.
  list(id, tiles, act) {
    $(id).replaceChildren(...tiles.map(([value, text, address, file]) => {
      const item = document.createElement("li"), button = document.createElement("button"), picture = document.createElement("img");
      picture.alt = ""; // the text says it
      if (address) picture.src = address;
      item.dataset.file = file ?? "";
      button.dataset.value = value;
      button.append(picture, text);
      button.addEventListener("click", () => act(value));
      item.append(button);
      this.show(item);
      return item;
    }));
  }

  picture({ file, picture }) {
    this.pictures.set(file, picture);
    for (const item of document.querySelectorAll(".tiles li")) if (item.dataset.file === file) this.show(item);
  }

  show(item) {
    const picture = this.pictures.get(item.dataset.file);
    if (picture) item.querySelector("img").src = `data:image/png;base64,${picture}`;
    else if (picture === null && item.parentElement?.id === "maps") item.hidden = true;
  }

  choose(map) {
    this.map.value = map;
    this.mark();
  }

  // The tile of the map that is written in the field is the chosen one.
  mark() {
    for (const button of $("maps").querySelectorAll("button")) button.ariaPressed = String(button.dataset.value === this.map.value.trim());
  }
}
