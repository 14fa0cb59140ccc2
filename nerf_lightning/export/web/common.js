// Shared by the pages of scenes and of pictures.
"use strict";

const $ = id => document.getElementById(id);
const middle = points => points.reduce((a, b) => [a[0] + b[0] / points.length, a[1] + b[1] / points.length], [0, 0]);
const spacing = ([a, b]) => b ? Math.max(1, Math.hypot(a[0] - b[0], a[1] - b[1])) : 1;

function keys(acts) {
  addEventListener("keydown", event => {
    if (event.ctrlKey || event.metaKey || event.altKey || /INPUT|SELECT|DIALOG/.test(event.target.tagName) || !(event.key in acts)) return;
    acts[event.key]();
    event.preventDefault();
  });
}

function fullScreen() {
  if (document.fullscreenElement) document.exitFullscreen();
  else document.documentElement.requestFullscreen?.().catch(() => {});
}

const hideHint = () => $("hint").classList.add("gone");
$("full").addEventListener("click", fullScreen);
$("information").addEventListener("click", () => $("facts").showModal());
