// Page of a picture: pan and zoom.

const view = $("view"), picture = $("picture"), held = new Map();
let place = [0, 0, 1];                      // upper left corner of the picture (screen pixels) and scale

function put(x, y, scale) {
  place = [x, y, scale];
  picture.style.transform = `translate(${x}px, ${y}px) scale(${scale})`;
  picture.style.imageRendering = scale > 3 ? "pixelated" : "auto";
}

function whole() {
  const scale = Math.min(view.clientWidth / picture.naturalWidth, view.clientHeight / picture.naturalHeight);
  put((view.clientWidth - scale * picture.naturalWidth) / 2, (view.clientHeight - scale * picture.naturalHeight) / 2, scale);
}

function closer(factor, x = view.clientWidth / 2, y = view.clientHeight / 2) {
  const by = Math.min(200, Math.max(0.05, place[2] * factor)) / place[2];
  put(x + (place[0] - x) * by, y + (place[1] - y) * by, place[2] * by);
}

view.addEventListener("pointerdown", event => { view.setPointerCapture(event.pointerId); held.set(event.pointerId, [event.clientX, event.clientY]); });
view.addEventListener("pointermove", event => {
  if (!held.has(event.pointerId)) return;
  const before = [...held.values()];
  held.set(event.pointerId, [event.clientX, event.clientY]);
  const after = [...held.values()], [was, is] = [before, after].map(middle);
  put(place[0] + is[0] - was[0], place[1] + is[1] - was[1], place[2]);
  if (after.length > 1) closer(spacing(after) / spacing(before), ...is);
  hideHint();
});
for (const name of ["pointerup", "pointercancel"]) view.addEventListener(name, event => held.delete(event.pointerId));
view.addEventListener("wheel", event => { event.preventDefault(); closer(Math.exp(-event.deltaY * 0.0015), event.clientX, event.clientY); }, { passive: false });
view.addEventListener("dblclick", event => closer(2, event.clientX, event.clientY));
const steps = {
  ArrowLeft: () => put(place[0] + 40, place[1], place[2]), ArrowRight: () => put(place[0] - 40, place[1], place[2]),
  ArrowUp: () => put(place[0], place[1] + 40, place[2]), ArrowDown: () => put(place[0], place[1] - 40, place[2]),
  "+": () => closer(1.25), "=": () => closer(1.25), "-": () => closer(0.8),
};
keys({ ...steps, r: whole, R: whole, f: fullScreen, F: fullScreen });
$("reset").addEventListener("click", whole);
addEventListener("resize", whole);
picture.decode().then(whole);
