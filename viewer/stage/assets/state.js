// What is shown: view, lamp, look and layers; and the document of notes that is kept with the run, with its undo.
import { add, clamp, onSphere, axesTowards, dot } from "./vectors.js";
import { byId, facts, groundPlace, served, toPage } from "./scene.js";

export const LOOKS = ["photo", "specular", "unsharp", "curvature", "normals", "known", "clay", "albedo"];
export const LOW = 0.03, HIGH = 0.998;        // radius of the lamp's place in the dome seen from above
// Elevation of the view, rad. Of an object that was laid anew the underside was photographed, too: it is seen from below.
export const HIGHEST = 1.5, LOWEST = facts.isWhole ? -HIGHEST : 0.06;
const FILLED = 0.94;                          // of the free part's sides, by the object
const MOST_UNDONE = 200;

export const home = { ...facts.cameras[0].home, focal: 2.2, shift: [0, 0] };
export let view = { ...home, shift: [0, 0] };
let room = null, isFramed = true;             // the window and its free part, px; whether the view keeps the object in it
export const lamp = { ...facts.lamp };
export const shown = {
  look: "photo", gain: 1, sharpness: 40, layers: { lights: false, camera: false, grid: false, notes: true, bar: true },
  photo: "", showing: [], wipe: 0.5, follows: true, drags: "light", material: "", surroundings: false,
};
export let stage = JSON.parse(byId("document").textContent);
const undone = [], redone = [];
const listeners = [];

export const onChange = (listener) => listeners.push(listener);
export const tell = (what) => { for (const listener of listeners) listener(what); };

// The eye and the axes of the view, in page lengths.
export const cameraNow = () => cameraOfView(view);

function cameraOfView({ azimuth, elevation, distance }) {
  return axesTowards(onSphere(azimuth, elevation).map((x) => x * distance / facts.radius), [0, 0, 0]);
}

export const lampPlace = () => onSphere(lamp.azimuth, lamp.elevation).map((x) => x * lamp.distance / facts.radius);

// Where a page place is on a screen of this size, px from its top left corner; and its depth.
export function onScreen(p, width, height, camera = cameraNow()) {
  const q = add(p, camera.eye, -1), z = dot(q, camera.forward), side = Math.min(width, height), f = view.focal * side;
  return [width / 2 + view.shift[0] * side + f * dot(q, camera.right) / z, height / 2 + view.shift[1] * side + f * dot(q, camera.down) / z, z];
}

// Focal length and shift with which the object fills the free part of the window, seen by a camera.
function fitted(camera) {
  const { width, height, free } = room, side = Math.min(width, height);
  const seen = facts.outline.map((p) => { const q = add(p, camera.eye, -1), z = dot(q, camera.forward); return [dot(q, camera.right) / z, dot(q, camera.down) / z]; });
  const ends = [0, 1].map((k) => [Math.min(...seen.map((q) => q[k])), Math.max(...seen.map((q) => q[k]))]);
  const focal = FILLED * Math.min(free.width / (ends[0][1] - ends[0][0]), free.height / (ends[1][1] - ends[1][0])) / side;
  return { focal, at: (f) => ({ focal: f, shift: [
    (free.left + free.width / 2 - width / 2) / side - f * (ends[0][0] + ends[0][1]) / 2,
    (free.top + free.height / 2 - height / 2) / side - f * (ends[1][0] + ends[1][1]) / 2,
  ] }) };
}

// Says which part of the window is free; the view follows, unless a hand has zoomed or shifted it.
export function frameObject(width, height, free) {
  room = { width, height, free };
  const best = fitted(cameraOfView(home));
  Object.assign(home, best.at(best.focal));
  if (isFramed) setView({});
}

// As large as at first, or smaller where the object would reach beyond the free part.
function framed() {
  const best = fitted(cameraNow());
  return best.at(Math.min(best.focal, home.focal));
}

// Where the picture that came with the page lies in the window, px: left, top, width.
export function firstPlace(width, height) {
  const side = Math.min(width, height), f = home.focal * side, [left, top, right] = facts.first;
  return [width / 2 + home.shift[0] * side + f * left, height / 2 + home.shift[1] * side + f * top, f * (right - left)];
}

export function setView(change) {
  if ("focal" in change || "shift" in change) isFramed = false;
  Object.assign(view, change);
  view.elevation = clamp(view.elevation, LOWEST, HIGHEST);
  if (isFramed) Object.assign(view, framed());
  view.focal = clamp(view.focal, home.focal * 0.25, home.focal * 60);
  tell("view");
}

export function setLamp(change) { Object.assign(lamp, change); tell("lamp"); }

export function goHome() {
  isFramed = true;
  setView({ azimuth: home.azimuth, elevation: home.elevation, distance: home.distance });
  setLamp({ ...facts.lamp, radius: lamp.radius, strength: lamp.strength });
}

export function turnView(dx, dy) { setView({ azimuth: view.azimuth - dx, elevation: view.elevation + dy }); }

// Zooms about a point of the window, given in shorter sides from its middle.
export function zoomView(factor, at = view.shift) {
  const focal = clamp(view.focal * factor, home.focal * 0.25, home.focal * 60), s = focal / view.focal;
  setView({ focal, shift: [at[0] + s * (view.shift[0] - at[0]), at[1] + s * (view.shift[1] - at[1])] });
}

// Where the eye is under the ground, which is then not drawn, the lamp is, too.
export const isBelow = () => cameraNow().eye[2] < groundPlace;

// The lamp's place is a point of a dome over the object, told from above: u towards the right of the view, v away.
export function lampFromAbove() {
  const r = Math.cos(lamp.elevation), a = lamp.azimuth - view.azimuth;
  return [r * Math.sin(a), -r * Math.cos(a)];
}

export function putLamp(u, v) {
  const r = clamp(Math.hypot(u, v), LOW, HIGH);
  setLamp({ azimuth: view.azimuth + Math.atan2(u, -v), elevation: (isBelow() ? -1 : 1) * Math.acos(r) });
}

// Lights from a calibrated place, in the world.
export function lampTo(place) {
  const q = toPage(place), d = Math.hypot(...q);
  setLamp({ azimuth: Math.atan2(q[1], q[0]), elevation: Math.asin(clamp(q[2] / d, -1, 1)), distance: Math.max(d, 1.3) * facts.radius });
}

export function setShown(change) { Object.assign(shown, change); tell("shown"); }

// --- the document -----------------------------------------------------------------------------------------------

export function editStage(change) {
  undone.push(JSON.stringify(stage));
  if (undone.length > MOST_UNDONE) undone.shift();
  redone.length = 0;
  stage = { ...stage, ...change };
  tell("stage");
  saveStage();
}

function step(from, to) {
  if (!from.length) return;
  to.push(JSON.stringify(stage));
  stage = JSON.parse(from.pop());
  tell("stage");
  saveStage();
}

export const undo = () => step(undone, redone);
export const redo = () => step(redone, undone);
export const canUndo = () => undone.length > 0;
export const canRedo = () => redone.length > 0;

let waiting = 0, socket = null, unsaved = false;
export let savedSentence = "";

function saveStage() {
  unsaved = true;
  savedSentence = served.saves ? "Saving ..." : "Kept in this window only. Share the page to keep it.";
  tell("saved");
  if (!served.saves) return;
  clearTimeout(waiting);
  waiting = setTimeout(sendStage, 400);
}

async function sendStage() {
  const text = JSON.stringify(stage);
  try {
    await (served.saves === "frame" ? throughFrame(text) : throughSocket(text));
    unsaved = false;
    savedSentence = "Saved with the run.";
  } catch (error) {
    savedSentence = `Not saved: ${(error.message || "the server does not answer").replace(/\.$/, "")}.`;
  }
  tell("saved");
}

// A page without an origin asks the page around it, which answers with a sentence where that failed.
function throughFrame(text) {
  return new Promise((resolve, reject) => {
    const hear = ({ source, data }) => {
      if (source !== parent || typeof data.kept !== "string") return;
      removeEventListener("message", hear);
      data.kept === "" ? resolve() : reject(new Error(data.kept));
    };
    addEventListener("message", hear);
    parent.postMessage({ keep: text }, "*");
  });
}

function throughSocket(text) {
  return new Promise((resolve, reject) => {
    socket = new WebSocket(new URL("stage.json", location.href.replace(/^http/, "ws")));
    socket.onopen = () => socket.send(text);
    socket.onmessage = (event) => { socket.close(); event.data === "" ? resolve() : reject(new Error(event.data)); };
    socket.onerror = () => reject(new Error("the server does not answer"));
  });
}

window.addEventListener("beforeunload", (event) => { if (unsaved && served.saves) event.preventDefault(); });
