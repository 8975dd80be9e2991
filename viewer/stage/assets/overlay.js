// What lies over the picture: lines in space (grid, camera, lights), the scale bar, and markers of notes.
import { add, clamp, norm } from "./vectors.js";
import { byId, cameraOf, facts, groundPlace, toPage } from "./scene.js";
import { cameraNow, onScreen, shown, stage, view } from "./state.js";
import { isHidden } from "./pick.js";

const GREY = [0.75, 0.78, 0.85, 0.35], STRONG = [0.75, 0.78, 0.85, 0.6], AMBER = [0.98, 0.7, 0.25, 0.9], PALE = [0.7, 0.72, 0.78, 0.5], CHOSEN = [1, 0.36, 0.22, 1];
const MOST_LETTERS = 36, LETTER_PX = 8; // of a note's text in the picture; the panel lists all of it
const BAR = 0.2;                     // of the window's width, about
const ns = "http://www.w3.org/2000/svg";

const niceLength = (about) => { const p = 10 ** Math.floor(Math.log10(about)); return p * [5, 2, 1].find((m) => m * p <= about); };
const line = (out, a, b, colour) => out.push(...a, ...colour, ...b, ...colour);

// Lines in space that are switched on, for drawLines.
export function linesInSpace() {
  const out = [], { layers } = shown;
  if (layers.grid) grid(out);
  if (layers.camera || shown.showing.length) for (const camera of facts.cameras) frustum(out, camera);
  if (layers.lights) for (const light of facts.lights) lampCross(out, light);
  if (stage.crop) cropBox(out);
  return out;
}

function grid(out) {
  const step = niceLength(facts.radius / 2) / facts.radius, z = groundPlace + 1e-3, most = 20;
  for (let i = -most; i <= most; i++) {
    const colour = i % 5 ? GREY : STRONG;
    line(out, [i * step, -most * step, z], [i * step, most * step, z], colour);
    line(out, [-most * step, i * step, z], [most * step, i * step, z], colour);
  }
}

// Of the photo beside the picture, or of the place that was asked about.
const isChosen = (camera) => shown.showing.includes(facts.cameras.indexOf(camera)) || (shown.photo && camera === cameraOf(shown.photo));

function frustum(out, camera) {
  const { eye, axes, focal, middle } = camera, colour = isChosen(camera) ? CHOSEN : AMBER, from = toPage(eye), depth = 0.35 * norm(from);
  const corners = [[0, 0], [1, 0], [1, 1], [0, 1]].map(([u, v]) => {
    const x = (u - middle[0]) / focal[0], y = (v - middle[1]) / focal[1];
    return add(add(add(from, axes[2], depth), axes[0], depth * x), axes[1], depth * y);
  });
  corners.forEach((corner, i) => { line(out, from, corner, colour); line(out, corner, corners[(i + 1) % 4], colour); });
}

function lampCross(out, light) {
  const p = toPage(light.place), s = 0.12, chosen = light.photo === shown.photo;
  const colour = chosen ? CHOSEN : light.used ? AMBER : PALE;
  for (const axis of [[s, 0, 0], [0, s, 0], [0, 0, s]]) line(out, add(p, axis, -1), add(p, axis), colour);
  if (chosen) line(out, p, [0, 0, 0], [1, 0.36, 0.22, 0.4]);
}

function cropBox(out) {
  const low = toPage(stage.crop.low), high = toPage(stage.crop.high), at = (i) => [0, 1, 2].map((k) => (i >> k & 1 ? high[k] : low[k]));
  for (let i = 0; i < 8; i++) for (let k = 0; k < 3; k++) if (!(i >> k & 1)) line(out, at(i), at(i | 1 << k), [0.5, 0.8, 1, 0.8]);
}

// --- the scale bar ----------------------------------------------------------------------------------------------

let barNow = "";

// True at the depth of the object's middle. An element is only touched when it changes: that alone repaints the page.
export function drawBar() {
  const bar = byId("bar"), isOn = shown.layers.bar, key = `${isOn} ${view.focal} ${view.distance} ${innerWidth} ${innerHeight}`;
  if (key === barNow) return;
  barNow = key;
  bar.hidden = !isOn;
  if (!isOn) return;
  const width = innerWidth, side = Math.min(width, innerHeight), px = view.focal * side / view.distance;
  const length = niceLength(Math.max(90, BAR * Math.min(width, 900)) / px);
  byId("bar-line").style.width = `${length * px}px`;
  byId("bar-text").textContent = `${Number(length.toPrecision(2))} ${facts.unit === "mm" ? "mm" : "units"}`;
}

// --- notes ------------------------------------------------------------------------------------------------------

const hiddenNotes = new Map();

// Redraws arrows, lengths and their texts; `settled` also asks which are behind the surface, which takes longer.
export function drawNotes(settled) {
  if (!stage.notes.length && !byId("notes").firstChild) return;
  const svg = byId("notes"), width = innerWidth, height = innerHeight, camera = cameraNow();
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  svg.replaceChildren();
  if (!shown.layers.notes) return;
  stage.notes.forEach((note, i) => {
    const key = JSON.stringify([note.at, note.to]);
    if (settled) hiddenNotes.set(key, isHidden(note.at));
    const group = document.createElementNS(ns, "g");
    group.setAttribute("class", `note${hiddenNotes.get(key) ? " behind" : ""}`);
    const at = onScreen(toPage(note.at), width, height, camera);
    if (at[2] <= 0) return;
    if (note.kind === "length") lengthMark(group, at, onScreen(toPage(note.to), width, height, camera), note.text, i);
    else arrowMark(group, at, onScreen(add(toPage(note.at), note.normal, 0.25), width, height, camera), note.text, i);
    svg.append(group);
  });
}

function arrowMark(group, at, up, text, i) {
  let way = [up[0] - at[0], up[1] - at[1]];
  const n = Math.hypot(...way), side = at[0] > innerWidth / 2 ? 1 : -1;
  way = n < 12 ? [40 * side, -40] : [way[0] * 64 / n, way[1] * 64 / n];
  const from = [at[0] + way[0], at[1] + way[1]];
  group.append(stroke(`M${from}L${at[0]} ${at[1]}`, "arrow"), label(from, way[1] > 0 ? 16 : -8, `${i + 1}. ${text}`, way[0]));
}

function lengthMark(group, a, b, text, i) {
  group.append(stroke(`M${a[0]} ${a[1]}L${b[0]} ${b[1]}`, "length"), label([(a[0] + b[0]) / 2, (a[1] + b[1]) / 2], -10, `${i + 1}. ${text}`, 0));
}

function stroke(d, kind) {
  const path = document.createElementNS(ns, "path");
  path.setAttribute("d", d);
  path.setAttribute("class", kind);
  return path;
}

function label([x, y], dy, text, way) {
  const words = document.createElementNS(ns, "text"), said = text.length > MOST_LETTERS ? `${text.slice(0, MOST_LETTERS)}\u2026` : text;
  const width = LETTER_PX * said.length, before = way > 8 ? 0 : way < -8 ? width : width / 2;
  words.setAttribute("x", clamp(x, before, Math.max(before, innerWidth - width + before)));
  words.setAttribute("y", y + dy);
  words.setAttribute("text-anchor", way > 8 ? "start" : way < -8 ? "end" : "middle");
  words.textContent = said;
  return words;
}
