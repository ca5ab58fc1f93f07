// Half floats on a canvas: WebGL2, or a 2D canvas where there is none or it would be drawn by software, which is
// slower. Exposure and tone mapping happen here.

// AgX as in core/tone_curves.py, rows of its matrices; and colours of stops from middle grey, -6 and less to 6 and more.
const INSET = [[0.8424791, 0.0784336, 0.0792237], [0.0423282, 0.8784686, 0.0791661], [0.0423757, 0.0784336, 0.879143]];
const OUTSET = [[1.196879, -0.0980209, -0.0990297], [-0.0528969, 1.1519031, -0.0989612], [-0.0529716, -0.0980435, 1.1510737]];
const CONTRAST = [15.5, -40.14, 31.96, -6.868, 0.4298, 0.1191, -0.00232], DARKEST = -12.47393, STOPS = 16.500003;
const BANDS = ["000000", "2b0a52", "1d2a8f", "1560bd", "1596c9", "17b3a0", "808080", "6cbf3b", "c9d62b", "f5c518", "f28a1c", "e23b2e", "ffffff"]
  .map((hex) => [0, 2, 4].map((i) => parseInt(hex.slice(i, i + 2), 16) / 255));
const GREY = 0.18, LUMINANCE = [0.2126, 0.7152, 0.0722];
const glsl = (values) => values.map((v) => Number(v).toFixed(8)).join(", ");
const glslRows = (rows) => `mat3(${rows.map(glsl).join(", ")})`;

const VERTEX = `#version 300 es
out vec2 at;
void main() {
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0;
  at = vec2(corner.x, 1.0 - corner.y);
  gl_Position = vec4(corner * 2.0 - 1.0, 0, 1);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D now, before;
uniform float scale, split;
uniform int curve, mode;
in vec2 at;
out vec4 color;
vec3 shown(vec3 e) {
  e = max(e * scale, 0.0);
  if (curve == 1) e = clip(e * (2.51 * e + 0.03) / (e * (2.43 * e + 0.59) + 0.14));
  else if (curve == 2) return log(1.0 + 100.0 * min(e, 1e4)) / log(10001.0) * 1.6;
  else if (curve == 3) {
    vec3 t = clamp((log2(max(e * ${glslRows(INSET)}, 1e-9)) - ${glsl([DARKEST])}) / ${glsl([STOPS])}, 0.0, 1.0);
    vec3 s = vec3(0);
    for (int i = 0; i < 7; i++) s = s * t + float[7](${glsl(CONTRAST)})[i];
    return clamp(s * ${glslRows(OUTSET)}, 0.0, 1.0);
  } else if (curve == 4) {
    float stops = log2(max(dot(e, vec3(${glsl(LUMINANCE)})), 1e-9) / ${glsl([GREY])});
    return vec3[13](${BANDS.map((c) => `vec3(${glsl(c)})`).join(", ")})[int(clamp(round(stops), -6.0, 6.0)) + 6];
  }
  return pow(e, vec3(1.0 / 2.2));
}`.replace("e = clip(", "e = (") + `
void main() {
  vec3 e = texture(now, at).rgb;
  if (mode == 1) { color = vec4(0.5 + e * 2.0, 1); return; }
  if (mode == 2) { color = vec4(e, 1); return; }
  if (at.x < split) e = texture(before, at).rgb;
  color = vec4(shown(e), 1);
  if (split > 0.0 && split < 1.0 && abs(at.x - split) < 0.002) color = vec4(1);
}`;

const SOFTWARE = /swiftshader|llvmpipe|softpipe|software|basic render/i;

// Whether WebGL2 draws on a graphics card.
export function accelerated() {
  const gl = document.createElement("canvas").getContext("webgl2", { failIfMajorPerformanceCaveat: true });
  if (!gl) return false;
  const name = gl.getExtension("WEBGL_debug_renderer_info")?.UNMASKED_RENDERER_WEBGL ?? gl.RENDERER;
  const software = SOFTWARE.test(gl.getParameter(name));
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return !software;
}

export class Display {
  // mode: "radiance", "signed" differences of display values, or "values" of a display.
  constructor(canvas, mode = "radiance", plain = false) {
    this.canvas = canvas;
    this.mode = ["radiance", "signed", "values"].indexOf(mode);
    this.settings = { stops: 0, curve: 0, split: 0 };
    this.gl = plain ? null : canvas.getContext("webgl2", { alpha: false, antialias: false });
    if (this.gl) this.prepare();
    else this.flat = canvas.getContext("2d");
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => { this.prepare(); this.upload(); });
  }

  prepare() {
    const gl = this.gl;
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) console.error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    gl.useProgram(program);
    this.at = (name) => gl.getUniformLocation(program, name);
    gl.uniform1i(this.at("now"), 0);
    gl.uniform1i(this.at("before"), 1);
    gl.uniform1i(this.at("mode"), this.mode);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    this.textures = [0, 1].map((unit) => {
      const texture = gl.createTexture();
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
      return texture;
    });
  }

  upload() {
    for (const [unit, frame] of [[0, this.now], [1, this.before]]) this.fill(unit, frame);
    this.draw();
  }

  fill(unit, frame) {
    if (!this.gl || !frame) return;
    const gl = this.gl;
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB16F, frame.width, frame.height, 0, gl.RGB, gl.HALF_FLOAT, frame.pixels);
  }

  show(frame) {
    this.now = frame;
    this.fill(0, frame);
    this.draw();
  }

  compare(frame) {
    this.before = frame;
    this.fill(1, frame);
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
      if (this.gl) this.drawGl();
      else this.drawFlat();
      this.drawn?.(this.now);
    });
  }

  drawGl() {
    const gl = this.gl, box = this.canvas.getBoundingClientRect();
    const width = Math.max(1, Math.round(box.width * devicePixelRatio)), height = Math.max(1, Math.round(box.height * devicePixelRatio));
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    gl.viewport(0, 0, width, height);
    gl.uniform1f(this.at("scale"), 2 ** this.settings.stops);
    gl.uniform1f(this.at("split"), this.before ? this.settings.split : 0);
    gl.uniform1i(this.at("curve"), this.settings.curve);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  drawFlat() {
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
    if (this.mode !== 0 || !show) {
      const bytes = this.bytes();
      return (data, to, pixels, of) => { for (let c = 0; c < 3; c++) data[to + c] = bytes[pixels[of + c]]; };
    }
    const scale = 2 ** stops;
    return (data, to, pixels, of) => {
      const shown = show([0, 1, 2].map((c) => Math.max(HALF[pixels[of + c]] * scale, 0)));
      for (let c = 0; c < 3; c++) data[to + c] = 255 * shown[c];
    };
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
    if (this.mode === 1) return 0.5 + 2 * e;
    if (this.mode === 2) return e;
    e = Math.max(e * scale, 0);
    if (this.settings.curve === 1) e = (e * (2.51 * e + 0.03)) / (e * (2.43 * e + 0.59) + 0.14);
    else if (this.settings.curve === 2) return (Math.log(1 + 100 * Math.min(e, 1e4)) / Math.log(10001)) * 1.6;
    return e ** (1 / 2.2);
  }
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
function agx(e) {
  const curve = (v) => {
    const t = Math.min(1, Math.max(0, (Math.log2(Math.max(v, 1e-9)) - DARKEST) / STOPS));
    return CONTRAST.reduce((sum, factor) => sum * t + factor, 0);
  };
  const display = INSET.map((row) => curve(dot(row, e)));
  return OUTSET.map((row) => Math.min(1, Math.max(0, dot(row, display))));
}
const band = (e) => BANDS[Math.min(12, Math.max(0, Math.round(Math.log2(Math.max(dot(LUMINANCE, e), 1e-9) / GREY) + 6)))];

const HALF = Float32Array.from({ length: 65536 }, (_, bits) => {
  const sign = bits & 0x8000 ? -1 : 1, exponent = (bits >> 10) & 31, fraction = bits & 1023;
  if (exponent === 0) return sign * fraction * 2 ** -24;
  return exponent === 31 ? sign * 65504 : sign * (1 + fraction / 1024) * 2 ** (exponent - 15);
});
