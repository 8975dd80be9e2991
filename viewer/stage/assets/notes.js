// Notes on the surface: arrows with a text and lengths with their uncertainty; saved views; copies of page and picture.
import { add, norm } from "./vectors.js";
import { byId, facts } from "./scene.js";
import { editStage, lamp, onScreen, setLamp, setShown, setView, shown, stage, view } from "./state.js";
import { camerasThatShow, pick, pointingSigma } from "./pick.js";

const original = document.documentElement.cloneNode(true);  // before anything was changed
export const tool = { kind: "", first: null, cross: [0, 0] };
let say = () => {};
export const notesSay = (speaker) => { say = speaker; };

const digits = () => (facts.unit === "mm" ? 1 : 3);

export function startTool(kind) {
  Object.assign(tool, { kind, first: null, cross: onScreen([0, 0, 0], innerWidth, innerHeight).slice(0, 2) });  // on the object's middle
  const touch = "Tap the surface, or move the cross with the arrow keys and press Enter. Escape, or the same button again, ends it.";
  say(kind === "length" ? `First end. ${touch}` : touch);
  showCross();
}

export function endTool() {
  if (tool.kind === "photos") setShown({ showing: [] });
  tool.kind = "";
  showCross();
  say("");
}

export function showCross() {
  const cross = byId("cross");
  cross.toggleAttribute("hidden", !tool.kind);
  cross.style.transform = `translate(${tool.cross[0]}px, ${tool.cross[1]}px)`;
}

export function moveCross(dx, dy) { tool.cross = [tool.cross[0] + dx, tool.cross[1] + dy]; showCross(); }

// Places what the tool makes at a point of the window.
export function placeAt(x, y) {
  const found = pick(x, y, innerWidth, innerHeight);
  if (!found) { say("There is no surface there. Choose a place on the object."); return; }
  if (tool.kind === "photos") { sayShowing(found); return; }
  const sigma = pointingSigma(found.at, found.normal, innerWidth, innerHeight);
  if (tool.kind === "length" && !tool.first) {
    tool.first = { ...found, sigma };
    say("Second end.");
    return;
  }
  const note = { kind: tool.kind, text: "", at: found.at, normal: found.normal };
  if (tool.kind === "length") {
    const length = norm(add(found.at, tool.first.at, -1)), spread = Math.hypot(sigma, tool.first.sigma);
    const guessed = Math.min(found.known, tool.first.known) < 0.25 ? ", an end lies on a guess" : "";
    const words = `${length.toFixed(digits())} \u00b1 ${spread.toFixed(digits())} ${facts.unit === "mm" ? "mm" : "units"} (pointing)${guessed}`;
    addNote({ ...note, at: tool.first.at, normal: tool.first.normal, to: found.at, text: words });
    endTool();
  } else askText(note);
}

// Says which views' photos show a place, and marks their cameras; the tool goes on until Escape.
function sayShowing({ at, normal }) {
  const found = camerasThatShow(at, normal), [best] = found, name = ({ number }) => facts.cameras[number].view || "the camera";
  setShown({ showing: found.map(({ number }) => number) });
  if (!best) { say("No photo shows this place."); return; }
  const others = found.slice(1).map((one) => `${name(one)} (${Math.round(one.angle)}\u00b0)`);
  say(`Shown best by ${name(best)}, ${Math.round(best.angle)}\u00b0 from straight on${others.length ? `; also by ${others.join(", ")}` : ""}.`);
}

function askText(note) {
  const dialog = byId("note-dialog"), field = byId("note-text");
  field.value = "";
  dialog.showModal();
  dialog.onclose = () => {
    if (dialog.returnValue === "keep" && field.value.trim()) addNote({ ...note, text: field.value.trim().slice(0, 500) });
    endTool();
    byId("picture").focus();
  };
}

const addNote = (note) => editStage({ notes: [...stage.notes, note] });
export const removeNote = (i) => editStage({ notes: stage.notes.filter((_, k) => k !== i) });

export function saveView() {
  const name = `View ${stage.views.length + 1}`;
  editStage({ views: [...stage.views, { name, view: { ...view, shift: [...view.shift] }, lamp: { ...lamp }, look: shown.look }] });
}

export function recallView(i) {
  const saved = stage.views[i];
  setView({ ...saved.view, shift: [...saved.view.shift] });
  setLamp(saved.lamp);
  setShown({ look: saved.look, follows: false });
}

export const removeView = (i) => editStage({ views: stage.views.filter((_, k) => k !== i) });

// --- copies -----------------------------------------------------------------------------------------------------

function download(name, blob) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

// This page as it came, with the notes of now; a copy asks nobody for anything.
export function sharePage() {
  const copy = original.cloneNode(true);
  const policy = copy.querySelector("meta[http-equiv]");
  policy.content = policy.content.replace("connect-src 'self'", "connect-src 'none'");
  copy.querySelector("#served").textContent = JSON.stringify({ saves: "", home: "" });
  copy.querySelector("#document").textContent = JSON.stringify(stage).replaceAll("<", "\\u003c");
  download(`${facts.name}.html`, new Blob([`<!doctype html>\n${copy.outerHTML}`], { type: "text/html" }));
}

export async function savePicture(redraw) {
  redraw();
  const canvas = byId("picture");
  canvas.toBlob((blob) => download(`${facts.name}.png`, blob));
}
