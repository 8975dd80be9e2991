// A phone that was let in. Two views of one page: it sends photos of its library, or its camera is live (https).

import { ask, h, morph } from "./dom.js";
import { dome } from "./hemisphere.js";
import { live } from "./live.js";
import { Sender, chooser, complaint, sending, unused } from "./upload.js";
import { voice } from "./voice.js";

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
  if (phone.problem) return [h("section", { class: "panel" }, h("h1", {}, "This phone is not connected"), h("p", { class: "bad" }, phone.problem))];
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

/** The view of a phone that sends photos from its library or camera app; `phone` is what both views share. */
function album(phone) {
  const loud = voice(phone.draw);
  let role = "";
  const take = (files) => phone.sender.add(files, role);
  addEventListener("beforeunload", (event) => { if (phone.sender.open.length) event.preventDefault(); });

  const page = ({ state, problem, sender }) => {
    const check = state.check;
    return [
      h("h1", {}, state.title),
      problem && h("p", { class: "bad" }, problem),
      h("section", { class: "panel" },
        h("p", {}, "Photograph with the camera app: exposure and focus locked, camera on a tripod. Then choose all photos here."),
        h("div", { class: "bar" }, chooser("Choose photos", { accept: "image/*,video/*" }, take, "main"), chooser("Take one now", { accept: "image/*", capture: "environment", multiple: false }, take)),
        h("label", {}, "They show ", h("select", { "aria-label": "What the photos show", value: role, onchange: (event) => { role = event.target.value; } },
          [["", "what they look like"], ["board", "the board, in room light"], ["lit", "the object under the flashlight"], ["light", "what the flashlight phone sees"], ["side", "the object from the side"]]
            .map(([value, words]) => h("option", { value, selected: value === role }, words)))),
        sending(sender),
        sender.open.length > 0 && h("p", { class: "small quiet" }, "Keep this page open. If the network drops, it goes on by itself.")),
      h("section", { class: "panel", "aria-live": "polite" },
        h("p", {}, `${state.counts.words}.`),
        state.bad.length > 0 && h("p", { class: "warn" }, unused(state.bad)),
        state.refused.length > 0 && h("p", { class: "bad" }, state.refused.slice(-3).map((one) => complaint(one.name, one.why)).join(" ")),
        check.sentence && h("p", { class: `verdict ${check.verdict}` }, check.sentence),
        !check.sentence && check.error && h("p", { class: "bad" }, check.error),
        check.advice.length > 0 && h("ul", { class: "plain" }, check.advice.map((text) => h("li", {}, text))),
        state.coach.advice && (check.is_old || !check.sentence) && h("p", { class: "verdict" }, state.coach.advice),
        loud.control(),
        state.coach.lights.length > 0 && dome(state.coach.lights.map((light) => ({ ...light, used: true })))),
    ].filter(Boolean);
  };

  const heard = (state) => loud.hear(state.bad, state.coach.advice);
  return { title: "Send photos to Shadowgraph", pause: () => (document.hidden ? 5000 : 1500), page, heard };
}

document.title = view.title;
try { await join(); } catch (error) { refused = error.message; }
refresh();
