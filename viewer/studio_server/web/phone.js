// A phone that was let in: it sends photos from its library or camera, and hears how they are.

import { ask, attempt, h, morph, plural } from "./dom.js";
import { dome } from "./hemisphere.js";
import { Sender, picked, sending } from "./upload.js";

const main = document.getElementById("main");
const sender = new Sender("", () => draw());
let state = null, problem = "", told = new Set(), role = "";

/** Show the code's secret once; the phone has a cookie from then on. */
export async function join() {
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
  fresh.append(...page());
  morph(main, fresh);
}

function page() {
  if (problem && !state) return [h("section", { class: "panel" }, h("h1", {}, "Not in"), h("p", { class: "bad" }, problem))];
  if (!state) return [h("p", { class: "quiet" }, "One moment.")];
  const check = state.check;
  return [
    h("h1", {}, state.title),
    problem && h("p", { class: "bad" }, problem),
    h("section", { class: "panel" },
      h("p", {}, "Photograph with the camera app: exposure and focus locked, camera on a tripod. Then choose all photos here."),
      h("div", { class: "bar" }, chooser("Choose photos", { accept: "image/*,video/*" }, "main"), chooser("Take one now", { accept: "image/*", capture: "environment", multiple: false })),
      h("label", {}, "They show ", h("select", { "aria-label": "What the photos show", value: role, onchange: (event) => { role = event.target.value; } },
        [["", "what they look like"], ["board", "the board, in room light"], ["lit", "the object under the flashlight"], ["light", "what the flashlight phone sees"], ["side", "the object from the side"]]
          .map(([value, words]) => h("option", { value, selected: value === role }, words)))),
      sending(sender),
      sender.open.length > 0 && h("p", { class: "small quiet" }, "Keep this page open. If the network drops, it goes on by itself.")),
    h("section", { class: "panel", "aria-live": "polite" },
      h("p", {}, `${plural(state.count, "photo")} in the capture${state.lit ? `, ${state.lit} under the flashlight` : ""}.`),
      state.bad.length > 0 && h("p", { class: "warn" }, "Take again: ", state.bad.slice(-5).map((one) => `${one.name} (${one.remarks[0][0]})`).join(", ")),
      state.refused.length > 0 && h("p", { class: "bad" }, state.refused.slice(-3).map((one) => `${one.name}: ${one.why}`).join(" ")),
      check.sentence && h("p", { class: `verdict ${check.verdict}` }, check.sentence),
      !check.sentence && check.error && h("p", { class: "bad" }, check.error),
      check.advice.length > 0 && h("ul", { class: "plain" }, check.advice.map((text) => h("li", {}, text))),
      state.coach.advice && (check.is_old || !check.sentence) && h("p", { class: "verdict" }, state.coach.advice),
      state.coach.lights.length > 0 && dome(state.coach.lights.map((light) => ({ ...light, used: true })))),
  ].filter(Boolean);
}

function chooser(words, more, kind = "") {
  const input = h("input", { type: "file", multiple: true, hidden: true, "aria-hidden": "true", tabindex: "-1", ...more,
    onchange: (event) => { sender.add(picked(event.target), role); event.target.value = ""; } });
  return h("span", {}, input, h("button", { class: kind, onclick: (event) => event.currentTarget.parentNode.querySelector("input").click() }, words));
}

async function refresh() {
  try {
    state = await ask("/api/state");
    problem = "";
    const fresh = state.bad.filter((one) => !told.has(one.name));
    if (fresh.length && navigator.vibrate) navigator.vibrate([200, 100, 200]);
    fresh.forEach((one) => told.add(one.name));
  } catch (error) {
    problem = error instanceof TypeError ? "The studio does not answer. This page waits for it." : error.message;
    if (!(error instanceof TypeError)) state = null;
  }
  draw();
  setTimeout(refresh, document.hidden ? 5000 : 1500);
}

if (document.title.startsWith("Send")) {
  addEventListener("beforeunload", (event) => { if (sender.open.length) event.preventDefault(); });
  attempt(async () => {
    try { await join(); } catch (error) { problem = error.message; }
    refresh();
  });
}
