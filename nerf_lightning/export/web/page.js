// Page of a field: mouse, touch and keyboard input, and the controls.

const about = JSON.parse($("about").textContent);
const QUALITY = [[0.2, 6], [0.35, 12], [0.5, 20], [0.75, 30], [1, 45]];  // fraction of the screen's pixels at rest, milliseconds while moving
const REST = 160, ROUND = 14000;            // milliseconds: idle time before the fine picture; one revolution of the turntable
const QUICK = 40;                           // maximum milliseconds for a half-size picture at which the turntable starts automatically
const CAMERA = "nerf_lightning camera";     // message kind that links the cameras of several pages

function posesOf(text, lenses) {
  const rows = new Float32Array(fromBase64(text).buffer), poses = [];
  for (let i = 0; i < rows.length; i += 12) poses.push(Camera.from(rows.subarray(i, i + 12), lenses[i / 12] ?? lenses[0], about.focus));
  return poses;
}

class Page {
  constructor(renderer) {
    this.renderer = renderer;
    this.canvas = renderer.canvas;
    this.orbit = posesOf(about.orbit.poses, about.orbit.lenses);
    this.photos = about.photos ? posesOf(about.photos.poses, about.photos.lenses) : [];
    this.camera = this.orbit[0].copy();
    this.up = about.up;
    this.turning = this.touched = false;
    this.poster = Boolean(about.poster);    // whether the poster shows the view, below the fine picture's finished rows
    this.turnedFor = 0;                     // milliseconds
    this.moved = -REST;
    this.atRest = Promise.resolve();
    this.hold();
    this.keys();
    this.controls();
    new ResizeObserver(() => this.resize()).observe(this.canvas);
    this.resize();
  }

  // After a change: a coarse picture next, and a fine one at rest.
  changed(by = "touch") {
    this.moved = performance.now();
    this.dirty = true;
    if (by !== "resize") this.poster = false;
    if (by === "touch") {
      this.turntable(false);
      this.flight = null;
      this.touched = true;
      this.stay();
    }
    if (by !== "message" && by !== "turntable" && window.parent !== window) parent.postMessage({ kind: CAMERA, camera: { ...this.camera } }, "*");
    if (!this.resting) this.atRest = new Promise(resolve => { this.resting = resolve; });
    this.wake();
  }

  // Keeps the eye within reach of the nearest photo's, looking at its target, unless switched off: elsewhere nothing was seen.
  stay() {
    const { camera } = this, { eye, target } = camera, from = place => Math.hypot(...add(eye, place, -1));
    if (!$("stay")?.checked || !this.photos.length) return;
    const near = this.photos.reduce((best, photo) => from(photo.eye) < from(best.eye) ? photo : best).eye;
    if (from(near) <= about.photos.reach) return;
    camera.eye = add(near, add(eye, near, -1), about.photos.reach / from(near));
    const ahead = unitLength(add(target, camera.eye, -1)), right = unitLength(cross(ahead, this.up));
    Object.assign(camera, { ahead, right, down: cross(ahead, right) });
  }

  wake() { this.frame ??= requestAnimationFrame(now => { this.frame = null; this.tick(now); }); }

  tick(now) {
    const { renderer, camera } = this, [share, milliseconds] = QUALITY[$("quality").value];
    const passed = Math.min(100, now - (this.last ?? now));
    this.last = now;
    if (renderer.gl.isContextLost()) return;
    if (this.flight) this.fly(now);
    else if (this.turning) this.onOrbit(this.turnedFor += passed);
    if (this.dirty) {
      this.dirty = false;
      if (this.poster) renderer.restart();
      else {
        renderer.draw(this.camera, milliseconds, share);
        this.canvas.style.background = "none";
        this.canvas.dataset.drawn = "coarse";
      }
      this.drawPhotos();
    } else if (now - this.moved > REST && !renderer.refine(camera, share)) {
      this.canvas.dataset.drawn = "fine";
      this.poster = false;
      this.resting?.();
      this.resting = this.last = null;
      return;                               // idle until the next change
    }
    this.wake();
  }

  onOrbit(time) {
    const at = time / ROUND * this.orbit.length, count = this.orbit.length, one = this.orbit[Math.floor(at) % count];
    this.camera = one.toward(this.orbit[(Math.floor(at) + 1) % count], at % 1);
    this.changed("turntable");
  }

  fly(now) {
    const { from, to, began } = this.flight, share = Math.min(1, (now - began) / 500), eased = share * share * (3 - 2 * share);
    this.camera = from.toward(to, eased);
    if (share === 1) this.flight = null;
    this.changed("flight");
  }

  flyTo(to) {
    this.changed();
    this.flight = { from: this.camera, to, began: performance.now() };
  }

  turntable(on) {
    this.turning = on;
    $("turn").setAttribute("aria-pressed", on);
    if (on) this.changed("turntable");
  }

  // Measured while drawing the last pictures.
  get quick() { return this.renderer.perPixel * this.canvas.width * this.canvas.height / 4 < QUICK; }

  resize() {
    const ratio = Math.min(devicePixelRatio, 2), [width, height] = this.fixed ?? [this.canvas.clientWidth * ratio, this.canvas.clientHeight * ratio].map(Math.round);
    if (!width || !height) return;
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    this.changed("resize");
  }

  at(event) {
    const box = this.canvas.getBoundingClientRect();
    return [(event.clientX - box.left) * this.canvas.width / box.width, (event.clientY - box.top) * this.canvas.height / box.height];
  }

  // Mouse, pen and touch: one pointer turns; two, or the right button, pan and zoom.
  hold() {
    const { canvas } = this, down = new Map();
    canvas.addEventListener("pointerdown", event => {
      canvas.setPointerCapture(event.pointerId);
      down.set(event.pointerId, this.at(event));
      this.changed();
    });
    canvas.addEventListener("pointermove", event => {
      if (!down.has(event.pointerId)) return;
      const before = [...down.values()];
      down.set(event.pointerId, this.at(event));
      const after = [...down.values()], [x, y] = add([...middle(after), 0], [...middle(before), 0], -1), { width, height } = canvas;
      if (after.length > 1) this.camera.approach(Math.min(2, Math.max(0.5, spacing(before) / spacing(after))));
      if (after.length > 1 || event.buttons & 2 || event.shiftKey) this.camera.slide(x, y, width, height);
      else this.camera.turn(-x / Math.min(width, height) * 3, -y / Math.min(width, height) * 3, this.up);
      hideHint();
      this.changed();
    });
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, event => down.delete(event.pointerId));
    canvas.addEventListener("contextmenu", event => event.preventDefault());
    canvas.addEventListener("wheel", event => {
      event.preventDefault();
      this.camera.approach(Math.exp(Math.max(-0.5, Math.min(0.5, event.deltaY * (event.deltaMode ? 0.05 : 0.0015)))));
      this.changed();
    }, { passive: false });
    canvas.addEventListener("dblclick", event => this.center(...this.at(event)));
  }

  center(x, y) {
    const place = this.renderer.placeAt(this.camera, x, y);
    if (!place) return;
    const to = this.camera.copy(), [fx, fy, cx, cy] = this.camera.lensOn(this.canvas.width, this.canvas.height), depth = dot(add(place, to.eye, -1), to.ahead);
    const aside = add(scaled(to.right, (this.canvas.width / 2 - cx) * depth / fx), to.down, (this.canvas.height / 2 - cy) * depth / fy);
    this.flyTo(Object.assign(to, { target: place, eye: add(add(place, to.ahead, -depth), aside, -1) }));
  }

  keys() {
    const step = 0.12, move = (name, ...by) => () => { this.camera[name](...by); this.changed(); }, home = () => this.flyTo(this.orbit[0]);
    keys({
      ArrowLeft: move("turn", -step, 0, this.up), ArrowRight: move("turn", step, 0, this.up),
      ArrowUp: move("turn", 0, -step, this.up), ArrowDown: move("turn", 0, step, this.up),
      "+": move("approach", 0.85), "=": move("approach", 0.85), "-": move("approach", 1 / 0.85),
      r: home, R: home, f: fullScreen, F: fullScreen,
    });
  }

  save(blob, name) {
    const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(blob), download: name });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  }

  controls() {
    const { look } = this.renderer, on = (id, name, act) => $(id).addEventListener(name, act);
    on("turn", "click", () => this.turntable(!this.turning));
    on("reset", "click", () => this.flyTo(this.orbit[0]));
    on("shot", "click", () => { this.renderer.present(); this.canvas.toBlob(blob => this.save(blob, about.file + ".png")); });
    on("file", "click", () => this.save(new Blob([fromBase64($("compact").textContent)]), about.file + ".npz"));
    const settings = open => { $("panel").hidden = !open; $("settings").setAttribute("aria-expanded", open); };
    on("settings", "click", () => settings($("panel").hidden));
    on("shut", "click", () => settings(false));
    addEventListener("keydown", event => { if (event.key === "Escape" && !$("facts").open) settings(false); });
    on("shown", "change", event => { look.shown = Number(event.target.value); this.changed("look"); });
    const behind = { run: [...about.background, 1], none: [0, 0, 0, 0], black: [0, 0, 0, 1], white: [1, 1, 1, 1] };
    on("behind", "change", event => { look.background = behind[event.target.value]; this.changed("look"); });
    on("quality", "input", () => this.changed("look"));
    const sliders = document.querySelectorAll(".crop");  // from and to of x, y and z
    const crop = () => { sliders.forEach((slider, i) => { look.keep[3 * (i % 2) + (i >> 1)] = Number(slider.value); }); this.changed("look"); };
    for (const slider of sliders) slider.addEventListener("input", crop);
    on("uncrop", "click", () => { sliders.forEach((slider, i) => { slider.value = i % 2; }); crop(); });
    this.photoControls();
  }

  photoControls() {
    if (!this.photos.length) return;
    about.photos.names.forEach((name, i) => $("photo").append(new Option(name, i)));
    $("photo").addEventListener("change", event => { if (event.target.value) this.flyTo(this.photos[event.target.value]); });
    $("stay")?.addEventListener("change", () => this.changed());
    $("frusta").addEventListener("change", () => this.changed("look"));
    this.marks = this.photos.map((photo, i) => {
      const mark = document.createElementNS("http://www.w3.org/2000/svg", "path"), title = document.createElementNS(mark.namespaceURI, "title");
      title.textContent = about.photos.names[i];
      mark.append(title);
      mark.addEventListener("click", () => this.flyTo(photo));
      $("cameras").append(mark);
      return mark;
    });
  }

  // Each photo's camera as a pyramid over the picture.
  drawPhotos() {
    const shown = Boolean($("frusta")?.checked);
    $("cameras").toggleAttribute("hidden", !shown);
    if (!shown) return;
    const { width, height } = this.canvas, deep = about.photos.depth;
    $("cameras").setAttribute("viewBox", `0 0 ${width} ${height}`);
    this.photos.forEach((photo, i) => {
      const [w, h, fx, fy, cx, cy] = photo.lens, corner = (u, v) => add(add(add(photo.eye, photo.ahead, deep), photo.right, (u - cx) / fx * deep), photo.down, (v - cy) / fy * deep);
      const seen = [photo.eye, corner(0, 0), corner(w, 0), corner(w, h), corner(0, h)].map(place => this.camera.project(place, width, height));
      const text = seen.every(Boolean) ? seen.map(([x, y]) => `${x.toFixed(1)} ${y.toFixed(1)}`) : null;
      this.marks[i].setAttribute("d", text ? `M${text.slice(1).join("L")}Z` + text.slice(1).map(c => `M${text[0]}L${c}`).join("") : "");
    });
  }

  // For other programs and linked pages: sets the camera, and the canvas size if given.
  show({ rows, lens }, size) {
    this.changed();
    if (size) this.fixed = size;
    this.camera = Camera.from(rows, lens, about.focus);
    this.resize();
    return this.atRest;
  }

  listen() {
    const numbers = (row, count) => Array.isArray(row) && row.length === count && row.every(Number.isFinite);
    addEventListener("message", ({ data }) => {
      const one = data?.kind === CAMERA && data.camera;
      if (!one || !numbers(one.lens, 6) || !["right", "down", "ahead", "eye", "target"].every(name => numbers(one[name], 3))) return;
      this.turntable(false);
      this.flight = null;
      Object.assign(this.camera, one);
      this.changed("message");
    });
  }
}

async function open() {
  document.body.classList.toggle("framed", window.parent !== window);
  if (about.poster) {                       // shown while a large shader compiles
    Object.assign($("view").style, { background: `center / contain no-repeat url(${about.poster})` });
    $("view").dataset.drawn = "poster";
    await new Promise(done => requestAnimationFrame(() => setTimeout(done)));
  }
  const compact = await Compact.read(fromBase64($("compact").textContent));
  const renderer = new Renderer($("view"), compact, about, $("march").textContent), page = new Page(renderer);
  $("view").addEventListener("webglcontextlost", event => { event.preventDefault(); $("view").dataset.drawn = "lost"; });
  $("view").addEventListener("webglcontextrestored", () => { renderer.prepare(); page.changed("look"); });
  page.listen();
  window.field = page;
  await page.atRest;
  const still = window.parent !== window || matchMedia("(prefers-reduced-motion: reduce)").matches;
  if (!still && !page.touched && page.quick) page.turntable(true);
}

open().catch(error => {
  $("message").hidden = false;
  $("message").textContent = error.message;
  throw error;
});
