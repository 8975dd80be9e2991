// The panel: reads and writes what is shown. Every control is a plain element of the page.
import { byId, facts, served } from "./scene.js";
import {
  canRedo, canUndo, editStage, lamp, lampFromAbove, lampTo, putLamp, redo, savedSentence, setLamp, setShown, setView, shown, stage, undo,
} from "./state.js";
import { endTool, recallView, removeNote, removeView, savePicture, saveView, sharePage, startTool, tool } from "./notes.js";
import { showPhoto } from "./renderer.js";

const RAKING = 8 * Math.PI / 180;
const NARROW = 700;
let whenMoved = () => {};
let fromCamera = 0;                  // number of the camera at whose place the view was put last
const unit_ = facts.unit === "mm" ? "mm" : "units";
const on = (id, event, act) => byId(id).addEventListener(event, act);
const KEYS = [
  ["Arrows", "move the lamp"], ["Shift and arrows", "turn the view"], ["Ctrl and arrows", "shift the picture"], ["+ and -", "zoom"],
  ["Home or 0", "back to the first view and lamp"], ["L", "the light follows the pointer, or stays"], ["1 to 8", "what is shown: 6 is what is known"],
  ["Ctrl Z, Ctrl Shift Z", "undo, redo"], ["Enter, Escape", "place a note at the cross, end it"], ["?", "this list"],
];
const ABOUT = [
  "Move the mouse: the lamp follows it over the object. Drag to turn, roll the wheel to zoom, drag with the right button to shift; a double click goes back. One finger moves the lamp, two turn and zoom; the buttons below the picture change what one finger does.",
  "The picture is the photo's own pixels: their colours without light, lit anew on the reconstructed surface. It is the same surface, light and shadow from all sides. What the photos do not show takes the colour of the nearest place that they show.",
  "\u201cWhat is known\u201d colours the surface: what was seen in the photos is light and plain, what shadows alone hold is striped, a guess is dark and crossed. The ground outside the photo is its mean colour.",
  "Light falls off with the square of the distance. Some comes from an overcast sky, as much as object and ground leave of it, and some bounces once. Raking light, specular enhancement and unsharp masking are those of reflectance transformation imaging. Curvature shows ridges light and grooves dark. Surroundings are a room that was made up.",
  "Crop box, smoothing and cutting the guess away are written into meshes that are exported from now on; the run's own mesh stays as it was, so that all can be undone. Here smoothing changes the shading alone.",
  "A length's \u00b1 is the error of pointing at both ends, one standard deviation; the surface's own error comes on top, and mesh.ply holds it for each vertex.",
];

export function usePanel(redraw) {
  const { materials, addresses } = facts;
  for (const name of Object.keys(materials.chosen)) byId("material").append(new Option(name[0].toUpperCase() + name.slice(1), name));
  for (const name of Object.keys(addresses.photos)) byId("photo").append(new Option(name, name));
  for (const place of document.querySelectorAll(".unit")) place.textContent = unit_;
  for (const text of ABOUT) byId("about").append(Object.assign(document.createElement("p"), { textContent: text }));
  legend();
  keyList();
  byId("softness").value = Math.sqrt(lamp.radius / facts.largestLamp);
  if (served.home) {
    const link = Object.assign(document.createElement("a"), { href: served.home, textContent: "The photos, lights and cameras of this run, in 3D" });
    byId("home-link").append(link);
  }
  lightControls();
  lookControls();
  documentControls();
  on("save-picture", "click", () => savePicture(redraw));
  on("share", "click", sharePage);
  on("list-keys", "click", listKeys);
  on("menu", "click", () => openPanel(byId("panel").hidden));
  cropRows();
  showStage();
  showLamp();
}

export function openPanel(isOpen) {
  byId("panel").hidden = !isOpen;
  if (isOpen) showLamp();
  byId("menu").setAttribute("aria-expanded", String(isOpen));
  whenMoved();
}

export const panelMoved = (act) => { whenMoved = act; };

// What the colours of "What is known" mean, with their shares of the surface.
function legend() {
  byId("legend").append(...facts.legend.map(({ sign, words, share }) => {
    const item = document.createElement("li");
    item.append(Object.assign(document.createElement("i"), { className: sign }), share === null ? words : `${Math.round(100 * share)} % ${words}`);
    return item;
  }));
}

function keyList() {
  const row = (tag, textContent) => Object.assign(document.createElement(tag), { textContent });
  for (const [keys, words] of KEYS) byId("key-list").append(row("dt", keys), row("dd", words));
}

export const listKeys = () => byId("keys").showModal();

export const isNarrow = () => innerWidth <= NARROW;

function lightControls() {
  on("follows", "change", (e) => setShown({ follows: e.target.checked }));
  on("height", "input", (e) => { setShown({ follows: false }); setLamp({ elevation: e.target.value * Math.PI / 180 }); });
  on("softness", "input", (e) => setLamp({ radius: facts.largestLamp * e.target.value ** 2 }));
  on("brightness", "input", (e) => setLamp({ strength: facts.lamp.strength * 2 ** e.target.value }));
  on("raking", "click", () => { setShown({ follows: false }); setLamp({ elevation: RAKING }); });
  on("surroundings", "change", (e) => setShown({ surroundings: e.target.checked }));
  const dome = byId("dome"), onDome = (e) => {
    const box = dome.getBoundingClientRect(), half = box.width / 2 * 0.92;
    setShown({ follows: false });
    putLamp((e.clientX - box.left - box.width / 2) / half, -(e.clientY - box.top - box.height / 2) / half);
  };
  dome.addEventListener("pointerdown", (e) => { dome.setPointerCapture(e.pointerId); onDome(e); });
  dome.addEventListener("pointermove", (e) => { if (e.buttons & 1) onDome(e); });
  for (const [id, drags] of [["drag-light", "light"], ["drag-view", "view"]]) on(id, "click", () => setShown({ drags }));
}

function lookControls() {
  on("look", "change", (e) => setShown({ look: e.target.value }));
  on("gain", "input", (e) => setShown({ gain: Number(e.target.value) }));
  on("material", "change", (e) => setShown({ material: e.target.value, surroundings: shown.surroundings || ["gold", "emerald"].includes(e.target.value) }));
  for (const box of document.querySelectorAll("[data-layer]")) box.addEventListener("change", () => {
    setShown({ layers: { ...shown.layers, [box.dataset.layer]: box.checked } });
  });
  on("photo", "change", (e) => {
    const name = e.target.value, light = facts.lights.find((one) => one.photo === name);
    setShown({ photo: name, follows: !name && shown.follows });
    if (light) lampTo(light.place);
    if (light && light.camera !== fromCamera) setView(facts.cameras[fromCamera = light.camera].home);
    byId("photo-said").textContent = !name ? "" : light && !light.used ? "This photo was not used." : "Left of the bar the photo, right of it the picture under the same light.";
    byId("wipe").hidden = !name;
    showPhoto(name);
  });
  on("wipe", "input", (e) => setShown({ wipe: Number(e.target.value) }));
}

function documentControls() {
  on("add-arrow", "click", () => startToolFrom("arrow"));
  on("add-length", "click", () => startToolFrom("length"));
  on("ask-photos", "click", () => startToolFrom("photos"));
  on("save-view", "click", saveView);
  on("guess", "change", (e) => editStage({ guess: e.target.value }));
  on("smooth", "change", (e) => editStage({ smooth: Math.min(Math.max(Number(e.target.value) || 0, 0), facts.radius) }));
  on("crop-off", "click", () => editStage({ crop: null }));
  on("undo", "click", undo);
  on("redo", "click", redo);
}

function startToolFrom(kind) {
  if (isNarrow()) openPanel(false);
  if (tool.kind === kind) endTool(); else startTool(kind);
  byId("picture").focus();
}

function cropRows() {
  for (let axis = 0; axis < 3; axis++) {
    const row = document.createElement("label"), span = document.createElement("span");
    row.append("xyz"[axis], span);
    ["low", "high"].forEach((end, i) => {
      const field = Object.assign(document.createElement("input"), { type: "number", id: `crop-${end}-${axis}`, step: "any" });
      field.setAttribute("aria-label", `${"xyz"[axis]} ${i ? "to" : "from"}`);
      field.addEventListener("change", readCrop);
      span.append(field, i ? "" : " to ");
    });
    byId("crop-rows").append(row);
  }
}

function readCrop() {
  const box = ["low", "high"].map((end) => [0, 1, 2].map((axis) => Number(byId(`crop-${end}-${axis}`).value)));
  if ([0, 1, 2].every((axis) => box[0][axis] < box[1][axis])) editStage({ crop: { low: box[0], high: box[1] } });
  else showStage();
}

// --- what changed -----------------------------------------------------------------------------------------------

export function showStage() {
  const crop = stage.crop || { low: facts.bounds[0], high: facts.bounds[1] };
  for (const end of ["low", "high"]) for (let axis = 0; axis < 3; axis++) byId(`crop-${end}-${axis}`).value = Number(crop[end][axis].toFixed(2));
  byId("guess").value = stage.guess;
  byId("smooth").value = stage.smooth;
  byId("undo").disabled = !canUndo();
  byId("redo").disabled = !canRedo();
  fill("note-list", stage.notes, (note) => note.text, () => {}, removeNote, "note");
  fill("view-list", stage.views, (saved) => saved.name, recallView, removeView, "view");
}

function fill(id, list, words, choose, remove, what) {
  byId(id).replaceChildren(...list.map((entry, i) => {
    const item = document.createElement("li"), gone = Object.assign(document.createElement("button"), { type: "button", textContent: "Remove" });
    gone.setAttribute("aria-label", `Remove ${what} ${i + 1}`);
    gone.addEventListener("click", () => remove(i));
    if (what === "view") {
      const go = Object.assign(document.createElement("button"), { type: "button", textContent: words(entry) });
      go.addEventListener("click", () => choose(i));
      item.append(go, gone);
    } else item.append(words(entry), gone);
    return item;
  }));
}

export function showLamp() {
  const [u, v] = lampFromAbove(), degrees = Math.round(lamp.elevation * 180 / Math.PI);
  byId("lamp").setAttribute("cx", 46 * u);
  byId("lamp").setAttribute("cy", -46 * v);
  byId("height").value = degrees;
  byId("where").textContent = `Lamp ${degrees}\u00b0 high, ${Number(lamp.distance.toPrecision(3))} ${unit_} away`;
}

export function showShown() {
  const isLegend = shown.look === "known";
  if (byId("legend").hidden === isLegend) { byId("legend").hidden = !isLegend; whenMoved(); }
  byId("follows").checked = shown.follows;
  byId("look").value = shown.look;
  byId("surroundings").checked = shown.surroundings;
  byId("drag-light").setAttribute("aria-pressed", String(shown.drags === "light"));
  byId("drag-view").setAttribute("aria-pressed", String(shown.drags === "view"));
}

export const showSaved = () => { byId("saved").textContent = savedSentence; };
