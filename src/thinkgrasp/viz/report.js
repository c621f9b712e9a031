// Turntables of the steps: each is built when it comes into view; only a few live at a time, because browsers allow
// a page few drawing contexts.

const MOST_LIVE = 6;
const live = [];

function unpack(layer) {
  const packed = decode(layer.positions, Int16Array), positions = new Float32Array(packed.length);
  for (let i = 0; i < packed.length; i++) positions[i] = layer.origin[i % 3] + layer.scale * packed[i];
  return { ...layer, positions, colors: decode(layer.colors, Uint8Array), visible: true, tinted: layer.tintable };
}

class Turntable {
  constructor(figure) {
    this.figure = figure;
    const scene = JSON.parse(figure.querySelector("script").textContent);
    this.canvas = figure.querySelector("canvas");
    this.layers = scene.layers.map(unpack);
    this.view = new View(scene);
    this.painter = WebGLPainter.create(this.canvas, this.layers) ?? new CanvasPainter(this.canvas);
    this.canvas.dataset.painter = this.painter.constructor.name;
    this.stop = new AbortController();
    this.watch = new ResizeObserver(() => this.redraw());
    this.watch.observe(this.canvas);
    connectPointer(this.canvas, this.view, () => this.redraw());
    this.on('[data-view="camera"]', () => this.view.reset());
    this.on('[data-view="close"]', () => this.view.closeUp());
    this.on(".wake", () => { figure.classList.add("awake"); this.canvas.focus({ preventScroll: true }); });
    this.on("[data-toggle]", (button) => button.setAttribute("aria-pressed", button.getAttribute("aria-pressed") !== "true"));
    figure.addEventListener("keydown", (event) => { if (event.key === "Escape") figure.classList.remove("awake"); }, { signal: this.stop.signal });
    if (scene.closing) this.view.closeUp();
    this.redraw();
  }

  on(selector, act) {
    for (const element of this.figure.querySelectorAll(selector)) {
      element.addEventListener("click", () => { act(element); this.redraw(); }, { signal: this.stop.signal });
    }
  }

  redraw() {
    if (this.pending) return;
    this.pending = requestAnimationFrame(() => {
      this.pending = 0;
      const shown = new Map([...this.figure.querySelectorAll("[data-toggle]")].map((b) => [b.dataset.toggle, b.getAttribute("aria-pressed") === "true"]));
      for (const layer of this.layers) layer.visible = shown.get(layer.name) ?? true;
      const ratio = this.painter instanceof WebGLPainter ? window.devicePixelRatio || 1 : 1;
      const width = Math.max(1, Math.round(this.canvas.clientWidth * ratio)), height = Math.max(1, Math.round(this.canvas.clientHeight * ratio));
      if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
      this.painter.draw(this.layers, this.view, width, height, ratio);
      this.canvas.dataset.drawn = "true";
    });
  }

  // Give the context back and leave a still picture in its place.
  close() {
    cancelAnimationFrame(this.pending);
    this.watch.disconnect();
    this.stop.abort();
    this.figure.classList.remove("awake");
    const fresh = this.canvas.cloneNode();
    for (const name of ["painter", "drawn"]) delete fresh.dataset[name];
    fresh.style.background = `center / 100% 100% url(${this.canvas.toDataURL("image/webp")})`;
    this.painter.gl?.getExtension("WEBGL_lose_context")?.loseContext();
    this.canvas.replaceWith(fresh);
  }
}

function show(figure) {
  const at = live.findIndex((table) => table.figure === figure);
  const [table] = at < 0 ? [new Turntable(figure)] : live.splice(at, 1);
  live.push(table);
  if (live.length > MOST_LIVE) live.shift().close();
}

const seen = new IntersectionObserver((entries) => {
  for (const entry of entries) if (entry.isIntersecting) show(entry.target);
}, { rootMargin: "150px" });
for (const figure of document.querySelectorAll("figure.space")) seen.observe(figure);

for (const figure of document.querySelectorAll("figure.space")) {
  figure.addEventListener("pointerleave", (event) => { if (!event.buttons && event.pointerType === "mouse") figure.classList.remove("awake"); });
}
