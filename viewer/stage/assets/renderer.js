// When what is drawn, and how finely: coarse while something moves, averaged over samples at rest.
import { GOLDEN, add, clamp, halton, norm } from "./vectors.js";
import { byId, facts, loadPicture, toPage } from "./scene.js";
import { drop, gl, pictureTexture, sharp, target } from "./gpu.js";
import { cameraNow, lamp, lampPlace, shown, stage, view } from "./state.js";
import { drawBlur, drawDepth, drawLight, drawLines, drawShow, drawSurface, gBufferFormats, lampPoint, pass, viewClip } from "./passes.js";

const MOVING_MS = 18;               // for one picture while something moves
const REST_MS = 350, REST_COARSEST = 2;  // for one sample at rest: beyond, the picture has fewer pixels
const COARSEST = 5, COARSE_AT_FIRST = 3;  // px of the screen per px of the picture
const QUIET_MS = 250;               // after the last movement comes rest
const LEAST_PART = 0.25;            // of the lamp's radius: 32 of these cover its disc twice, so that none is seen alone
const BLUR = 0.035;                 // radii of the object: unsharp masking and curvature look at forms of this size
const SHARPER = 1.1;                // times the pixels of the first picture: below, the photo's own would show nothing new
const canvas = byId("picture");
const sized = { moving: {}, rest: {} };
let coarse = COARSE_AT_FIRST, atRest = 1, pace = 0, restsAt = 0, scheduled = false, count = 0, movedAt = 0, screen_ = [0, 0], painter = () => [], firstDrawn = () => {};
let isSharpened = false, surfaceOf = "", shadowOf = "", light = null, seen = null, sizes = 0;
export const pace_ = { frames: [], pointer: [], firstPaint: 0 };
export const samplesDone = () => count;

export function startRenderer(lines, drawn) { painter = lines; firstDrawn = drawn; draw("stage"); }

export function draw(what, since = 0) {
  count = 0;
  if (what === "view" || what === "stage" || what === "fine") surfaceOf = "";
  if (what === "lamp" || what === "stage") shadowOf = "";
  if (what !== "fine" && what !== "size" && what !== "still") restsAt = performance.now() + QUIET_MS;
  if (since && !movedAt) movedAt = since;
  schedule();
}

function schedule() { if (!scheduled) { scheduled = true; requestAnimationFrame(frame); } }

// px of the screen; the canvas has fewer while something moves, and the browser enlarges it.
function screenSize() {
  const ratio = Math.min(window.devicePixelRatio || 1, 2);
  const full = [canvas.clientWidth, canvas.clientHeight].map((x) => Math.max(1, Math.round(x * ratio)));
  if (full[0] !== screen_[0] || full[1] !== screen_[1]) { screen_ = full; count = 0; }
  return full;
}

function sizeCanvas(width, height) {
  if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
}

// Targets of one size; those of motion and of rest are kept apart, so that none is made anew at each touch.
function targetsOf(kind, width, height) {
  const have = sized[kind];
  if (have.width !== width || have.height !== height || (needsBlur() && !have.blur)) {
    for (const old of Object.values(have)) if (old && old.frame) drop(old);
    const half = [gl.RGBA16F, gl.HALF_FLOAT];
    sized[kind] = {
      width, height, surface: target(width, height, gBufferFormats(), 1),
      blur: needsBlur() ? target(width, height, [half], 0) : null, between: needsBlur() ? target(width, height, [half], 0) : null,
      mean: kind === "rest" ? target(width, height, [[sharp.internal, sharp.type]], 0) : null,
      spare: kind === "rest" ? target(width, height, [[sharp.internal, sharp.type]], 0) : null,
    };
    surfaceOf = "";
    sizes++;
  }
  return sized[kind];
}

const needsBlur = () => stage.smooth > 0 || shown.look === "unsharp" || shown.look === "curvature";

function drawView(kind, have, jitter) {
  const key = `${kind} ${jitter} ${needsBlur()} ${stage.smooth}`;
  if (surfaceOf === key) return;
  const camera = cameraNow();
  seen = { ...viewClip(camera, have.width, have.height, jitter), camera, away: norm(camera.eye) };
  drawSurface(have.surface, seen, kind === "moving");
  if (needsBlur()) drawBlur(have.surface, have.blur, have.between, seen, stage.smooth > 0 ? stage.smooth / facts.radius : BLUR);
  surfaceOf = key;
}

function drawShadow(isMoving, sample) {
  const key = `${isMoving} ${lamp.radius > 0 ? sample : 0}`;
  if (shadowOf === key) return;
  // A sample is a part of the lamp's disc, each smaller than the last; places and part together spread as the disc does.
  const radius = lamp.radius / facts.radius, part = Math.max(LEAST_PART, 1 / Math.sqrt(sample + 1)), angle = 2 * Math.PI * (sample * GOLDEN % 1);
  const place = lampPoint(lampPlace(), radius, Math.sqrt((1 - part * part) * halton(sample, 2)), angle), map = isMoving ? pass.shadowMoving : pass.shadow;
  const strength = lamp.strength * (lamp.distance / facts.radius) ** 2;
  light = { shadow: drawDepth(map, place, isMoving), map, place, reach: part * radius, strength, ambient: facts.ambient * lamp.strength / facts.lamp.strength };
  shadowOf = key;
}

function frame(now) {
  scheduled = false;
  const full = screenSize(), isMoving = performance.now() < restsAt, begun = performance.now();
  const slow = Math.sqrt(pace * full[0] * full[1] / REST_MS);
  if (!count) atRest = clamp(Math.ceil(2 * slow) / 2, 1, REST_COARSEST);
  const factor = isMoving ? coarse : atRest, width = Math.ceil(full[0] / factor), height = Math.ceil(full[1] / factor);
  const made = sizes, have = targetsOf(isMoving ? "moving" : "rest", width, height);
  const canvasSize = isMoving ? [width, height] : full;
  sizeCanvas(...canvasSize);
  if (isMoving) moving(have); else resting(have, full);
  drawLines(painter(), withoutJitter(canvasSize), have.surface.depthMap, canvasSize);
  if (isMoving || count < 3 || !(count % 8)) wait();
  const spent = performance.now() - begun;
  if (isMoving) {
    if (made === sizes) adapt(spent);
    pace_.frames.push(spent);
    if (movedAt) { pace_.pointer.push(performance.now() - movedAt); movedAt = 0; }
  } else pace = spent / (width * height);
  if (!pace_.firstPaint) { pace_.firstPaint = performance.now(); firstDrawn(); }
  if (isMoving || count < sharp.samples) schedule();
}

// A picture is finished when one pixel of it can be read.
function wait() { gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4)); }

function adapt(spent) {
  const wanted = clamp(coarse * Math.sqrt(spent / MOVING_MS), 1, COARSEST);
  if (wanted > 1.15 * coarse || wanted < 0.75 * coarse) coarse = clamp(Math.round(4 * (0.5 * coarse + 0.5 * wanted)) / 4, 1, COARSEST);
}

function moving(have) {
  drawView("moving", have, [0, 0]);
  drawShadow(true, 0);
  drawLight({ frame: null, width: have.width, height: have.height }, have.surface, needsBlur() ? have.blur : null, seen, light);
}

function resting(have, full) {
  const jitter = count ? [halton(count, 2) - 0.5, halton(count, 3) - 0.5] : [0, 0];
  drawView("rest", have, jitter);
  drawShadow(false, count);
  drawLight(have.mean, have.surface, needsBlur() ? have.blur : null, seen, light, count, have.spare.textures[0]);
  [have.mean, have.spare] = [have.spare, have.mean];
  count++;
  drawShow(have.spare.textures[0], have.width / full[0], have.height / full[1], full);
  if (count === 1) sharpen(full);
}

const withoutJitter = (full) => { const camera = cameraNow(); return { ...viewClip(camera, ...full, [0, 0]), camera }; };

// Loads the photo's own pixels once the screen shows the object larger than the first picture of it is.
async function sharpen(full) {
  const { fine, fineNormals } = facts.addresses, [, , w, h] = facts.objectWindow, camera = facts.cameras[0];
  const px = view.focal * Math.min(...full) * norm(toPage(camera.eye)) / norm(cameraNow().eye) / camera.focal[0] * Math.max(w, h);
  if (!fine || isSharpened || px < SHARPER * pass.objectPx) return;
  isSharpened = true;
  const [picture, normals] = await Promise.all([loadPicture(fine), loadPicture(fineNormals)]);
  [pass.fine, pass.fineNormals] = [pictureTexture(picture, true), pictureTexture(normals, false)];
  draw("fine");
}

export async function showPhoto(name) {
  if (pass.photo) gl.deleteTexture(pass.photo);
  pass.photo = name && facts.addresses.photos[name] ? pictureTexture(await loadPicture(facts.addresses.photos[name]), true) : null;
  draw("shown");
}
