// The studio's one page: which view the address asks for, and a question to the server every second or so.

import { ask, h, morph, toast } from "./dom.js";
import { home } from "./home.js";
import { capture } from "./capture.js";
import { run } from "./result.js";

const VIEWS = { "": home, capture, run };
const main = document.getElementById("main");
let view = null, timer = 0, turn = 0, isLost = false;

function route() {
  const [name, ...rest] = location.hash.replace(/^#\/?/, "").split("/");
  const make = VIEWS[name] || home;
  document.querySelectorAll("dialog").forEach((box) => box.dispatchEvent(new Event("cancel"))); // Back asks for another page
  if (view && view.close) view.close();
  view = make(decodeURIComponent(rest.join("/")), again);
  main.className = view.wide ? "wide" : "";
  morphed(h("p", { class: "quiet" }, "One moment."));
  refresh(true);
}

function morphed(...nodes) {
  const fresh = main.cloneNode(false);
  fresh.append(...nodes);
  morph(main, fresh);
}

async function refresh(isFirst = false) {
  clearTimeout(timer);
  const mine = ++turn, shown = view;
  let wait = 1000;
  try {
    const nodes = await shown.render(ask);
    if (mine !== turn || shown !== view) return;
    morphed(...[nodes].flat());
    if (isFirst) { main.focus({ preventScroll: true }); window.scrollTo(0, 0); }
    if (isLost) { isLost = false; toast("The studio is back."); }
    wait = shown.pause || 1000;
  } catch (error) {
    if (mine !== turn || shown !== view) return;
    if (error instanceof TypeError) { // no answer at all
      if (!isLost) toast("The studio does not answer; runs go on. This page waits for it.", true);
      isLost = true;
    } else morphed(h("section", { class: "panel" }, h("h1", {}, "This cannot be shown"), h("p", {}, error.message),
      h("p", {}, h("a", { href: "#/" }, "All captures"))));
    wait = 2000;
  }
  timer = setTimeout(refresh, document.hidden ? 5000 : wait);
}

/** Show at once what a click has changed. */
function again() { refresh(); }

addEventListener("hashchange", route);
document.addEventListener("visibilitychange", () => { if (!document.hidden) refresh(); });
if (new URLSearchParams(location.search).has("again")) {
  toast("The studio of this folder was open already: this is it.");
  history.replaceState(null, "", location.pathname + location.hash);
}
route();
