// A phone that was let in. Two views of one page: it sends photos of its library, or its camera is live (https).

import { ask, h, morph } from "./dom.js";
import { album } from "./album.js";
import { live } from "./live.js";
import { Sender } from "./upload.js";

const main = document.getElementById("main");
const phone = { state: null, problem: "", draw };
phone.sender = new Sender("", draw);
let refused = ""; // why the code did not let this phone in
const view = (location.pathname === "/live" ? live : album)(phone);

/** Show the code's secret once; the phone has a cookie from then on. */
async function join() {
  const token = location.hash.slice(1);
  if (!token) return;
  history.replaceState(null, "", location.pathname);
  const name = /iPhone|iPad|Android|Pixel|Windows|Macintosh|Linux/.exec(navigator.userAgent);
  const body = JSON.stringify({ token, name: name ? name[0] : "a phone" });
  const response = await fetch("/join", { method: "POST", body, headers: { "Content-Type": "application/json" }, credentials: "same-origin" });
  if (!response.ok) throw new Error((await response.json().catch(() => ({}))).error || "The code was not taken.");
}

function draw() {
  const fresh = main.cloneNode(false);
  fresh.append(...page().filter(Boolean));
  morph(main, fresh);
}

function page() {
  if (phone.state) return view.page(phone);
  if (phone.problem) return [h("section", { class: "panel" }, h("h1", {}, "Not in"), h("p", { class: "bad" }, phone.problem))];
  return [h("p", { class: "quiet" }, "One moment.")];
}

async function refresh() {
  try {
    phone.state = await ask("/api/state");
    phone.problem = refused = "";
    view.heard(phone.state);
  } catch (error) {
    phone.problem = error instanceof TypeError ? "The studio does not answer. This page waits for it." : refused || error.message;
    if (!(error instanceof TypeError)) phone.state = null;
  }
  draw();
  setTimeout(refresh, view.pause());
}

document.title = view.title;
try { await join(); } catch (error) { refused = error.message; }
refresh();
