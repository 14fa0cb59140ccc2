// Forwards one page's camera messages to all others.
"use strict";
addEventListener("message", event => {
  if (event.data?.kind !== "nerf_lightning camera") return;
  for (const frame of document.querySelectorAll("iframe"))
    if (frame.contentWindow !== event.source) frame.contentWindow.postMessage(event.data, "*");
});
