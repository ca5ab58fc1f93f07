// Half floats on a canvas. Exposure and tone mapping happen here.

// AgX as in core/tone_curves.py, rows of its matrices; and colours of stops from middle grey, -6 and less to 6 and more.
const INSET = [[0.8424791, 0.0784336, 0.0792237], [0.0423282, 0.8784686, 0.0791661], [0.0423757, 0.0784336, 0.879143]];
const OUTSET = [[1.196879, -0.0980209, -0.0990297], [-0.0528969, 1.1519031, -0.0989612], [-0.0529716, -0.0980435, 1.1510737]];
const CONTRAST = [15.5, -40.14, 31.96, -6.868, 0.4298, 0.1191, -0.00232], DARKEST = -12.47393, STOPS = 16.500003;
const BANDS = ["000000", "2b0a52", "1d2a8f", "1560bd", "1596c9", "17b3a0", "808080", "6cbf3b", "c9d62b", "f5c518", "f28a1c", "e23b2e", "ffffff"]
  .map((hex) => [0, 2, 4].map((i) => parseInt(hex.slice(i, i + 2), 16)));
const GREY = 0.18, LUMINANCE = [0.2126, 0.7152, 0.0722];

export class Display {
  // mode: "radiance", "signed" differences of display values, or "values" of a display.
  constructor(canvas, mode = "radiance") {
    this.canvas = canvas;
    this.mode = mode;
    this.settings = { stops: 0, curve: 0, split: 0 };
    this.flat = canvas.getContext("2d");
  }

  show(frame) {
    this.now = frame;
    this.draw();
  }

  compare(frame) {
    this.before = frame;
    this.draw();
  }

  set(changed) {
    Object.assign(this.settings, changed);
    this.draw();
  }

  draw() {
    if (!this.now || this.due) return;
    this.due = true;
    requestAnimationFrame(() => {
      this.due = false;
      this.drawNow();
      this.drawn?.(this.now);
    });
  }

  drawNow() {
    const { width, height, pixels } = this.now, { canvas } = this;
    if (canvas.width !== width || canvas.height !== height || !this.image) {
      Object.assign(canvas, { width, height });
      this.image = this.flat.createImageData(width, height);
      this.image.data.fill(255); // opaque
    }
    const paint = this.painter(), data = this.image.data;
    for (let i = 0; i < width * height; i++) paint(data, 4 * i, pixels, 3 * i);
    if (this.before) this.drawBefore(paint, data, width, height);
    this.flat.putImageData(this.image, 0, 0);
  }

  // What writes one texel to the bytes of an image. Of the last two curves a channel depends on the others.
  painter() {
    const { stops, curve } = this.settings, show = [agx, band][curve - 3];
    if (this.mode !== "radiance" || !show) {
      const bytes = this.bytes();
      return (data, to, pixels, of) => { for (let c = 0; c < 3; c++) data[to + c] = bytes[pixels[of + c]]; };
    }
    const linear = HALF.map((e) => Math.max(e * 2 ** stops, 0));
    return (data, to, pixels, of) => show(linear[pixels[of]], linear[pixels[of + 1]], linear[pixels[of + 2]], data, to);
  }

  // The left part as it was before, whose frame may have another size.
  drawBefore(paint, data, width, height) {
    const { before } = this, edge = Math.min(width, Math.ceil(this.settings.split * width));
    for (let y = 0; y < height; y++) {
      const row = Math.floor(((y + 0.5) * before.height) / height) * before.width;
      for (let x = 0; x < edge; x++) {
        const of = 3 * (row + Math.floor(((x + 0.5) * before.width) / width)), to = 4 * (y * width + x);
        paint(data, to, before.pixels, of);
      }
    }
  }

  // What each half float is shown as, under the present exposure and tone mapping.
  bytes() {
    const { stops, curve } = this.settings, key = `${stops} ${curve}`;
    if (this.shownAs?.key !== key) {
      const values = Uint8ClampedArray.from(HALF, (e) => 255 * this.value(e, 2 ** stops));
      this.shownAs = { key, values };
    }
    return this.shownAs.values;
  }

  value(e, scale) {
    if (this.mode === "signed") return 0.5 + 2 * e;
    if (this.mode === "values") return e;
    e = Math.max(e * scale, 0);
    if (this.settings.curve === 1) e = (e * (2.51 * e + 0.03)) / (e * (2.43 * e + 0.59) + 0.14);
    else if (this.settings.curve === 2) return (Math.log(1 + 100 * Math.min(e, 1e4)) / Math.log(10001)) * 1.6;
    return e ** (1 / 2.2);
  }
}

// Radiance r, g, b as bytes of an image from an index on; a large map has millions: no arrays are made.
const dot = (row, r, g, b) => row[0] * r + row[1] * g + row[2] * b;
const contrast = (v) => {
  const t = Math.min(1, Math.max(0, (Math.log2(Math.max(v, 1e-9)) - DARKEST) / STOPS));
  let sum = 0;
  for (const factor of CONTRAST) sum = sum * t + factor;
  return sum;
};
function agx(r, g, b, data, to) {
  const x = contrast(dot(INSET[0], r, g, b)), y = contrast(dot(INSET[1], r, g, b)), z = contrast(dot(INSET[2], r, g, b));
  for (let c = 0; c < 3; c++) data[to + c] = 255 * dot(OUTSET[c], x, y, z);
}
function band(r, g, b, data, to) {
  const stops = Math.log2(Math.max(dot(LUMINANCE, r, g, b), 1e-9) / GREY), color = BANDS[Math.min(12, Math.max(0, Math.round(stops) + 6))];
  for (let c = 0; c < 3; c++) data[to + c] = color[c];
}

const HALF = Float32Array.from({ length: 65536 }, (_, bits) => {
  const sign = bits & 0x8000 ? -1 : 1, exponent = (bits >> 10) & 31, fraction = bits & 1023;
  if (exponent === 0) return sign * fraction * 2 ** -24;
  return exponent === 31 ? sign * 65504 : sign * (1 + fraction / 1024) * 2 ** (exponent - 15);
});
