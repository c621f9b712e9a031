"use strict";
// A turntable over layers of points, lines and triangles. Coordinates are the camera's: x right, y down, z forward, metres.

const NEAR = 0.02;
const FAR = 30;
const BACKGROUND = [20, 23, 27];
const TINT = [255, 184, 28];
const TINT_SHARE = 0.5;

function decode(base64, ArrayType) {
  const bytes = Uint8Array.from(atob(base64), (c) => c.charCodeAt(0));
  return new ArrayType(bytes.buffer);
}

function rotationAbout([x, y, z], angle) {
  const c = Math.cos(angle), s = Math.sin(angle), k = 1 - c;
  return [
    [c + x * x * k, x * y * k - z * s, x * z * k + y * s],
    [y * x * k + z * s, c + y * y * k, y * z * k - x * s],
    [z * x * k - y * s, z * y * k + x * s, c + z * z * k],
  ];
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const multiply = (a, b) => a.map((row) => [0, 1, 2].map((j) => row[0] * b[0][j] + row[1] * b[1][j] + row[2] * b[2][j]));
const transform = (m, v) => m.map((row) => row[0] * v[0] + row[1] * v[1] + row[2] * v[2]);

// The view maps p to rotation * (p - pivot) + offset. It starts as the real camera's and turns about the pivot.
class View {
  constructor(scene) {
    this.camera = scene.camera;
    this.pivot = scene.pivot;
    this.up = scene.up;
    this.closing = scene.closing;
    this.reset();
  }

  reset() {
    this.rotation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
    this.offset = [...this.pivot];
  }

  // Near, from a low angle, with the fingers side by side.
  closeUp() {
    this.reset();
    this.offset = [0, 0, Math.min(0.45, this.pivot[2])];
    const x = [1, 0, 0], c = this.closing ?? x;
    const yaw = Math.atan2(dot(this.up, cross(c, x)), dot(c, x) - dot(this.up, c) * dot(this.up, x));
    this.rotate(yaw - Math.PI * Math.round(yaw / Math.PI), 0);
    const elevation = Math.asin(-transform(this.rotation, this.up)[2]);
    this.rotate(0, 0.45 - elevation);
  }

  rotate(yaw, pitch) {
    this.rotation = multiply(this.rotation, rotationAbout(this.up, yaw));
    const next = multiply(rotationAbout([1, 0, 0], pitch), this.rotation);
    const steepness = Math.abs(transform(next, this.up)[2]);
    if (steepness < 0.995 || steepness < Math.abs(transform(this.rotation, this.up)[2])) this.rotation = next;
  }

  zoom(factor) {
    const z = Math.min(Math.max(this.offset[2] * factor, 0.06), 8);
    const applied = z / this.offset[2];
    this.offset = this.offset.map((v) => v * applied);
  }

  pan(dx, dy, lens) {
    this.offset[0] += (dx / lens.fx) * this.offset[2];
    this.offset[1] += (dy / lens.fy) * this.offset[2];
  }

  // Pinhole [px] that shows the whole camera image in a canvas of this size.
  lens(width, height) {
    const c = this.camera;
    const s = Math.min(width / c.width, height / c.height);
    return {
      fx: c.fx * s, fy: c.fy * s,
      cx: (c.cx + 0.5 - c.width / 2) * s + width / 2, cy: (c.cy + 0.5 - c.height / 2) * s + height / 2,
    };
  }

  translation() {
    const turned = transform(this.rotation, this.pivot);
    return this.offset.map((v, i) => v - turned[i]);
  }
}

const VERTEX_SHADER = `
attribute vec3 position; attribute vec3 color;
uniform mat4 modelView; uniform mat4 projection; uniform float splat, largest;
varying vec3 tone;
void main() {
  vec4 p = modelView * vec4(position, 1.0);
  gl_Position = projection * p;
  gl_PointSize = clamp(splat * position.z / max(p.z, 0.01), 1.0, largest);
  tone = color;
}`;
const FRAGMENT_SHADER = `
precision mediump float;
varying vec3 tone; uniform vec4 tint; uniform float alpha;
void main() { gl_FragColor = vec4(mix(tone, tint.rgb, tint.a), alpha); }`;

class WebGLPainter {
  static create(canvas, layers) {
    const gl = canvas.getContext("webgl", { antialias: true, preserveDrawingBuffer: true });
    return gl ? new WebGLPainter(gl, layers) : null;
  }

  constructor(gl, layers) {
    this.gl = gl;
    const program = gl.createProgram();
    for (const [type, source] of [[gl.VERTEX_SHADER, VERTEX_SHADER], [gl.FRAGMENT_SHADER, FRAGMENT_SHADER]]) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.bindAttribLocation(program, 0, "position");
    gl.bindAttribLocation(program, 1, "color");
    gl.linkProgram(program);
    gl.useProgram(program);
    this.uniform = (name) => gl.getUniformLocation(program, name);
    this.buffers = new Map(layers.map((layer) => [layer, [this.upload(layer.positions), this.upload(layer.colors)]]));
    gl.enableVertexAttribArray(0);
    gl.enableVertexAttribArray(1);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
  }

  upload(array) {
    const buffer = this.gl.createBuffer();
    this.gl.bindBuffer(this.gl.ARRAY_BUFFER, buffer);
    this.gl.bufferData(this.gl.ARRAY_BUFFER, array, this.gl.STATIC_DRAW);
    return buffer;
  }

  draw(layers, view, width, height, pixelRatio) {
    const gl = this.gl, lens = view.lens(width, height), r = view.rotation, t = view.translation();
    gl.viewport(0, 0, width, height);
    gl.depthMask(true);
    gl.clearColor(...BACKGROUND.map((v) => v / 255), 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(this.uniform("modelView"), false, [
      r[0][0], r[1][0], r[2][0], 0, r[0][1], r[1][1], r[2][1], 0, r[0][2], r[1][2], r[2][2], 0, t[0], t[1], t[2], 1,
    ]);
    gl.uniformMatrix4fv(this.uniform("projection"), false, [
      (2 * lens.fx) / width, 0, 0, 0,
      0, (-2 * lens.fy) / height, 0, 0,
      (2 * lens.cx) / width - 1, 1 - (2 * lens.cy) / height, (FAR + NEAR) / (FAR - NEAR), 1,
      0, 0, (-2 * FAR * NEAR) / (FAR - NEAR), 0,
    ]);
    gl.uniform1f(this.uniform("largest"), 14 * pixelRatio);
    for (const layer of layers) {
      if (!layer.visible) continue;
      const [positions, colors] = this.buffers.get(layer);
      gl.bindBuffer(gl.ARRAY_BUFFER, positions);
      gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
      gl.bindBuffer(gl.ARRAY_BUFFER, colors);
      gl.vertexAttribPointer(1, 3, gl.UNSIGNED_BYTE, true, 0, 0);
      gl.uniform1f(this.uniform("splat"), lens.fx * layer.spacing);
      gl.uniform1f(this.uniform("alpha"), layer.alpha);
      gl.uniform4f(this.uniform("tint"), ...TINT.map((v) => v / 255), layer.tinted ? TINT_SHARE : 0);
      if (layer.alpha < 1) gl.enable(gl.BLEND); else gl.disable(gl.BLEND);
      gl.depthMask(layer.alpha === 1);
      const mode = { points: gl.POINTS, lines: gl.LINES, triangles: gl.TRIANGLES }[layer.kind];
      gl.drawArrays(mode, 0, layer.positions.length / 3);
    }
  }
}

// The same picture without WebGL: a depth buffer in an ImageData.
class CanvasPainter {
  constructor(canvas) {
    this.context = canvas.getContext("2d");
  }

  draw(layers, view, width, height, pixelRatio) {
    this.width = width;
    this.height = height;
    this.image = this.context.createImageData(width, height);
    this.depth = new Float32Array(width * height).fill(FAR);
    const background = (255 << 24) | (BACKGROUND[2] << 16) | (BACKGROUND[1] << 8) | BACKGROUND[0];
    new Int32Array(this.image.data.buffer).fill(background);
    const lens = view.lens(width, height);
    for (const layer of layers) {
      if (!layer.visible) continue;
      const seen = this.project(layer.positions, view, lens);
      if (layer.kind === "points") this.points(layer, seen, lens.fx * layer.spacing, 14 * pixelRatio);
      if (layer.kind === "lines") this.lines(layer, seen);
      if (layer.kind === "triangles") this.triangles(layer, seen);
    }
    this.context.putImageData(this.image, 0, 0);
  }

  project(positions, view, lens) {
    const r = view.rotation, t = view.translation(), out = new Float32Array(positions.length);
    for (let i = 0; i < positions.length; i += 3) {
      const x = positions[i], y = positions[i + 1], z = positions[i + 2];
      const depth = r[2][0] * x + r[2][1] * y + r[2][2] * z + t[2];
      out[i] = ((r[0][0] * x + r[0][1] * y + r[0][2] * z + t[0]) / depth) * lens.fx + lens.cx;
      out[i + 1] = ((r[1][0] * x + r[1][1] * y + r[1][2] * z + t[1]) / depth) * lens.fy + lens.cy;
      out[i + 2] = depth;
    }
    return out;
  }

  put(x, y, z, layer, vertex) {
    if (x < 0 || y < 0 || x >= this.width || y >= this.height) return;
    const at = y * this.width + x;
    if (z > this.depth[at]) return;
    if (layer.alpha === 1) this.depth[at] = z;
    for (let c = 0; c < 3; c++) {
      const tone = layer.tinted ? layer.colors[vertex * 3 + c] * (1 - TINT_SHARE) + TINT[c] * TINT_SHARE : layer.colors[vertex * 3 + c];
      this.image.data[at * 4 + c] = tone * layer.alpha + this.image.data[at * 4 + c] * (1 - layer.alpha);
    }
  }

  points(layer, seen, splat, largest) {
    for (let i = 0; i < seen.length; i += 3) {
      const z = seen[i + 2];
      if (z < NEAR) continue;
      const size = Math.max(1, Math.round(Math.min((splat * layer.positions[i + 2]) / z, largest)));
      const x0 = Math.round(seen[i] - size / 2), y0 = Math.round(seen[i + 1] - size / 2);
      for (let y = y0; y < y0 + size; y++) for (let x = x0; x < x0 + size; x++) this.put(x, y, z, layer, i / 3);
    }
  }

  lines(layer, seen) {
    for (let i = 0; i < seen.length; i += 6) {
      const [x0, y0, z0, x1, y1, z1] = seen.subarray(i, i + 6);
      if (z0 < NEAR || z1 < NEAR) continue;
      const steps = Math.min(4000, Math.ceil(Math.max(Math.abs(x1 - x0), Math.abs(y1 - y0))));
      for (let k = 0; k <= steps; k++) {
        const a = k / Math.max(steps, 1);
        const z = 1 / ((1 - a) / z0 + a / z1);
        this.put(Math.floor(x0 + a * (x1 - x0)), Math.floor(y0 + a * (y1 - y0)), z, layer, i / 3);
      }
    }
  }

  triangles(layer, seen) {
    for (let i = 0; i < seen.length; i += 9) {
      const [ax, ay, az, bx, by, bz, cx, cy, cz] = seen.subarray(i, i + 9);
      const area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay);
      if (Math.min(az, bz, cz) < NEAR || Math.abs(area) < 1e-9) continue;
      const left = Math.max(0, Math.floor(Math.min(ax, bx, cx))), right = Math.min(this.width - 1, Math.ceil(Math.max(ax, bx, cx)));
      const top = Math.max(0, Math.floor(Math.min(ay, by, cy))), bottom = Math.min(this.height - 1, Math.ceil(Math.max(ay, by, cy)));
      for (let y = top; y <= bottom; y++) for (let x = left; x <= right; x++) {
        const b = ((x - ax) * (cy - ay) - (cx - ax) * (y - ay)) / area;
        const c = ((bx - ax) * (y - ay) - (x - ax) * (by - ay)) / area;
        if (b < 0 || c < 0 || b + c > 1) continue;
        this.put(x, y, 1 / ((1 - b - c) / az + b / bz + c / cz), layer, i / 3);
      }
    }
  }
}

function connectPointer(canvas, view, redraw) {
  const pointers = new Map();
  const lens = () => view.lens(canvas.clientWidth, canvas.clientHeight);
  const spread = () => {
    const [a, b] = [...pointers.values()];
    return { size: Math.hypot(a.x - b.x, a.y - b.y), x: (a.x + b.x) / 2, y: (a.y + b.y) / 2 };
  };
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => pointers.delete(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    const last = pointers.get(event.pointerId);
    if (!last) return;
    const before = pointers.size === 2 ? spread() : null;
    const dx = event.clientX - last.x, dy = event.clientY - last.y;
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (before) {
      const after = spread();
      view.zoom(before.size / Math.max(after.size, 1));
      view.pan(after.x - before.x, after.y - before.y, lens());
    } else if (event.shiftKey || event.buttons & 2) {
      view.pan(dx, dy, lens());
    } else {
      view.rotate(dx * 0.006, dy * 0.006);
    }
    redraw();
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const lines = event.deltaMode === 1 ? event.deltaY * 16 : event.deltaY;
    view.zoom(Math.exp(Math.max(-200, Math.min(200, lines)) * 0.0015));
    redraw();
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const turn = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[event.key];
    if (!turn) return;
    event.preventDefault();
    view.rotate(...turn);
    redraw();
  });
}

function start() {
  const scene = JSON.parse(document.getElementById("scene").textContent);
  const canvas = document.getElementById("canvas");
  const layers = scene.layers.map((layer) => ({
    ...layer, positions: decode(layer.positions, Float32Array), colors: decode(layer.colors, Uint8Array), visible: true, tinted: layer.tintable,
  }));
  const view = new View(scene);
  const painter = WebGLPainter.create(canvas, layers) ?? new CanvasPainter(canvas);
  canvas.dataset.painter = painter.constructor.name;

  let pending = false;
  const redraw = () => {
    if (pending) return;
    pending = true;
    requestAnimationFrame(() => {
      pending = false;
      const ratio = painter instanceof WebGLPainter ? window.devicePixelRatio || 1 : 1;
      const width = Math.max(1, Math.round(canvas.clientWidth * ratio)), height = Math.max(1, Math.round(canvas.clientHeight * ratio));
      if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
      painter.draw(layers, view, width, height, ratio);
    });
  };

  connectPointer(canvas, view, redraw);
  for (const box of document.querySelectorAll("input[data-layer]")) {
    const apply = () => {
      for (const layer of layers) {
        if (layer.name !== box.dataset.layer) continue;
        if (layer.tintable) layer.tinted = box.checked; else layer.visible = box.checked;
      }
      redraw();
    };
    box.addEventListener("change", apply);
    apply();
  }
  document.getElementById("camera-view").addEventListener("click", () => { view.reset(); redraw(); });
  document.getElementById("close-up").addEventListener("click", () => { view.closeUp(); redraw(); });
  new ResizeObserver(redraw).observe(canvas);
}

// A page with several views has no scene of this name, and starts them itself.
if (document.getElementById("scene")) start();
