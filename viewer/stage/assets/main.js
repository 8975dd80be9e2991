// Begins: opens the canvas, loads the scene, draws the first picture, and joins hands, panel and renderer.
import { byId, facts, loadMesh, loadPicture } from "./scene.js";
import { openCanvas, sharp } from "./gpu.js";
import { openPasses, preparePasses } from "./passes.js";
import { draw, pace_, samplesDone, startRenderer } from "./renderer.js";
import { firstPlace, frameObject, lamp, onChange, setLamp, setShown, setView, shown, view } from "./state.js";
import { drawBar, drawNotes, linesInSpace } from "./overlay.js";
import { notesSay } from "./notes.js";
import { pickFrom } from "./pick.js";
import { useHands } from "./hands.js";
import { isNarrow, openPanel, panelMoved, showLamp, showSaved, showShown, showStage, usePanel } from "./panel.js";

const SETTLED_MS = 250;
const ROOMY = 1100;                  // px of a window in which the panel is open at first
const LAMP_SAID_MS = 200;
let pointerAt = 0, settling = 0, lampWaits = 0;

// The part of the window that nothing lies over: below title and buttons, above buttons and legend, beside or above an open panel.
function freePart() {
  const [header, tools, modes, legend, panel] = ["header", "#tools", "#modes", "#legend", "#panel"].map((name) => document.querySelector(name).getBoundingClientRect());
  const tops = [modes, legend, isNarrow() ? panel : {}].filter((box) => box.height).map((box) => box.top);  // what is hidden has no height
  const top = Math.max(header.bottom, tools.bottom), bottom = Math.min(innerHeight, ...tops);
  const width = panel.height && !isNarrow() ? panel.left : innerWidth;
  return bottom - top < innerHeight / 4 ? { left: 0, top: 0, width, height: innerHeight } : { left: 0, top, width, height: bottom - top };
}

const reframe = () => frameObject(innerWidth, innerHeight, freePart());
const freeMiddle = () => { const free = freePart(); return [free.left + free.width / 2, free.top + free.height / 2]; };

function changed(what) {
  if (what === "lamp" || what === "view") sayLampSoon();
  if (what === "shown") showShown();
  if (what === "stage") showStage();
  if (what === "saved") { showSaved(); return; }
  draw(what, pointerAt);
  pointerAt = 0;
  if (what === "view" || what === "stage" || what === "shown") {
    drawBar();
    drawNotes(false);
    clearTimeout(settling);
    settling = setTimeout(() => drawNotes(true), SETTLED_MS);
  }
}

// The lamp's words and sign follow five times a second: each change of them repaints the page.
function sayLampSoon() {
  if (lampWaits || byId("panel").hidden) return;
  lampWaits = setTimeout(() => { lampWaits = 0; showLamp(); }, LAMP_SAID_MS);
}

// The picture of the first view that came with the page, until the page has drawn its own.
function showFirst() {
  const [left, top, width] = firstPlace(innerWidth, innerHeight), { style } = byId("first");
  Object.assign(style, { left: `${left}px`, top: `${top}px`, width: `${width}px`, height: `${width}px` });
  byId("first").hidden = false;
}

function sayProblem(text) {
  byId("problem").hidden = false;
  byId("problem").textContent = text;
}

async function begin() {
  const canvas = byId("picture"), { addresses } = facts;
  usePanel(() => draw("still"));
  window.addEventListener("resize", reframe);
  panelMoved(reframe);
  openPanel(innerWidth >= ROOMY);
  showFirst();
  await new Promise((done) => requestAnimationFrame(() => setTimeout(done)));  // it is on the screen before what follows
  openCanvas(canvas);
  openPasses();
  const [mesh, object, ground, normals] = await Promise.all([
    loadMesh(), loadPicture(addresses.object), loadPicture(addresses.ground), addresses.normals ? loadPicture(addresses.normals) : null,
  ]);
  preparePasses(mesh, { object, ground, normals });
  pickFrom(mesh);
  notesSay((text) => { byId("hint").textContent = text; });
  useHands(freeMiddle, (at) => { pointerAt = at; });
  onChange(changed);
  canvas.addEventListener("webglcontextlost", (e) => { e.preventDefault(); sayProblem("The graphics card gave up. Reload the page."); });
  startRenderer(linesInSpace, () => byId("first").remove());
  drawBar();
  drawNotes(true);
  if (window === window.top) canvas.focus({ preventScroll: true });  // in a frame the keys may belong to the page around it
}

// For whoever embeds the page: where camera and lamp are (radians and the scene's unit), and how to move them.
window.shadowgraph = {
  state: () => ({ view: { ...view }, lamp: { ...lamp }, shown: { ...shown }, samples: samplesDone(), finest: sharp ? sharp.samples : 0 }),
  set: (state) => { if (state.view) setView(state.view); if (state.lamp) setLamp(state.lamp); if (state.shown) setShown(state.shown); },
  pace: pace_,
};
begin().catch((error) => sayProblem(`This picture cannot be shown here: ${error.message}.`));
