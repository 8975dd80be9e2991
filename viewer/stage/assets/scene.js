// The scene: decodes what viewer/stage/parts.py packed. Lengths of the page are radii of the object from its middle.
import { add, dot, scaled } from "./vectors.js";

export const byId = (id) => document.getElementById(id);
export const facts = JSON.parse(byId("scene").textContent);
export const served = JSON.parse(byId("served").textContent);
export const toPage = (p) => scaled(add(p, facts.centre, -1), 1 / facts.radius);
export const groundPlace = (facts.groundHeight - facts.centre[2]) / facts.radius;  // height of the ground, page lengths
// Where a camera's photo shows a place (page lengths): shares of its width and height, as photo.glsl; null outside.
export function inPhoto({ eye, axes, focal, middle, distortion: d, fisheye, field }, p) {
  const q = add(p, toPage(eye), -1), [x, y, z] = axes.map((axis) => dot(q, axis)), a = x / z, b = y / z, r2 = a * a + b * b, r = Math.sqrt(r2);
  if (z < 1e-4 || (!fisheye && r > field)) return null;
  const t = Math.atan(r), t2 = t * t, round = t * (1 + t2 * (d[0] + t2 * (d[1] + t2 * (d[2] + t2 * d[3])))) / Math.max(r, 1e-9);
  const along = fisheye ? round : 1 + r2 * (d[0] + r2 * (d[1] + r2 * d[4]));
  const aside = fisheye ? [0, 0] : [2 * d[2] * a * b + d[3] * (r2 + 2 * a * a), d[2] * (r2 + 2 * b * b) + 2 * d[3] * a * b];
  const spot = [middle[0] + focal[0] * (along * a + aside[0]), middle[1] + focal[1] * (along * b + aside[1])];
  return spot.every((share) => share > 0 && share < 1) ? spot : null;
}
// The camera that took a photo.
export const cameraOf = (photo) => facts.cameras[facts.lights.find((one) => one.photo === photo)?.camera ?? 0];
export const toWorld = (p) => add(facts.centre, scaled(p, facts.radius));

// Square roots of linear colour for sRGB bytes: a shader squares them, which costs less than the curve of sRGB.
const ROOTS = Uint8Array.from({ length: 256 }, (_, i) => {
  const c = i / 255;
  return Math.round(255 * Math.sqrt(c > 0.04045 ? ((c + 0.055) / 1.055) ** 2.4 : c / 12.92));
});

// The bytes of a data address: the page has all its parts in it.
function bytesOf(address) {
  const text = atob(address.slice(address.indexOf(",") + 1)), out = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) out[i] = text.charCodeAt(i);
  return out;
}

async function unpacked(address) {
  if (typeof DecompressionStream === "undefined") throw new Error("this browser is too old to unpack the scene");
  const stream = new Blob([bytesOf(address)]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

export async function loadMesh() {
  const raw = await unpacked(facts.addresses.block), { places, normals, colours, evidence, gloss, corners, sky, below, bounce, tint, groundSky } = facts.parts;
  const n = places.count, m = corners.count;
  const place = new Float32Array(3 * n), facing = new Int16Array(4 * n), paint = new Uint8Array(4 * n), shine = new Uint8Array(4 * n);
  const bounced = new Int8Array(4 * n), soft = new Uint8Array(4 * n);
  for (let axis = 0; axis < 3; axis++) {
    const high = places.offset + axis * n, low = high + 3 * n, from = places.low[axis], step = (places.high[axis] - from) / 65535;
    const nHigh = normals.offset + axis * n, nLow = nHigh + 3 * n, tint = colours.offset + axis * n;
    for (let i = 0; i < n; i++) {
      place[3 * i + axis] = from + step * (raw[high + i] << 8 | raw[low + i]);
      facing[4 * i + axis] = (raw[nHigh + i] << 8 | raw[nLow + i]) << 16 >> 16;
      paint[4 * i + axis] = ROOTS[raw[tint + i]];
    }
  }
  for (let i = 0; i < n; i++) {
    paint[4 * i + 3] = Math.min(255, 128 * raw[evidence.offset + i]);
    for (let k = 0; k < 4; k++) bounced[4 * i + k] = raw[bounce.offset + k * n + i];
    for (let k = 0; k < 3; k++) soft[4 * i + k] = raw[tint.offset + k * n + i];
    soft[4 * i + 3] = raw[sky.offset + i];
    facing[4 * i + 3] = 128.5 * raw[below.offset + i];
  }
  const kinds = facts.gloss ? facts.gloss.lobes.length : 0;
  for (let k = 0; k < kinds; k++) for (let i = 0; i < n; i++) shine[4 * i + k] = raw[gloss.offset + k * n + i];
  const index = new Uint32Array(m);
  for (let i = 0, at = corners.offset, last = 0; i < m; i++, at++) {
    const z = (raw[at] << 24 | raw[at + m] << 16 | raw[at + 2 * m] << 8 | raw[at + 3 * m]) >>> 0;
    last += z & 1 ? -((z + 1) / 2) : z / 2;
    index[i] = last;
  }
  const side = groundSky.count, ground = { side, sky: raw.slice(groundSky.offset, groundSky.offset + side * side) };
  return { place, facing, paint, shine, bounced, soft, index, count: n, ground };
}

// A picture as the graphics card takes it: decoded beside the page's own thread, its numbers as they are in the file.
export async function loadPicture(address) {
  const file = new Blob([bytesOf(address)], { type: "image/jpeg" });
  return createImageBitmap(file, { colorSpaceConversion: "none", premultiplyAlpha: "none" });
}

// Coarser triangles for pictures in motion: vertices that share a cell become one [Rossignac and Borrel 1993].
// The mesh left when the object's box has `cells` cells along its longest side; only the vertices that it needs.
export function coarser(mesh, cells) {
  const { place, index, count } = mesh, low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  for (let i = 0, at = 0; i < count; i++) for (let k = 0; k < 3; k++, at++) {
    if (place[at] < low[k]) low[k] = place[at];
    if (place[at] > high[k]) high[k] = place[at];
  }
  const step = Math.max(high[0] - low[0], high[1] - low[1], high[2] - low[2]) / cells, n = low.map((from, k) => Math.floor((high[k] - from) / step) + 1);
  const owner = new Int32Array(n[0] * n[1] * n[2]).fill(-1), cell = new Int32Array(count), kept = new Int32Array(count), out = new Uint32Array(index.length);
  const per = 1 / step, across = n[0], level = n[0] * n[1];
  let vertices = 0;
  for (let i = 0, at = 0; i < count; i++, at += 3) {
    const c = ((place[at] - low[0]) * per | 0) + across * ((place[at + 1] - low[1]) * per | 0) + level * ((place[at + 2] - low[2]) * per | 0);
    if (owner[c] < 0) { owner[c] = vertices; kept[vertices++] = i; }
    cell[i] = owner[c];
  }
  let corners = 0;
  for (let i = 0; i < index.length; i += 3) {
    const a = cell[index[i]], b = cell[index[i + 1]], c = cell[index[i + 2]];
    if (a === b || b === c || c === a) continue;
    out[corners] = a; out[corners + 1] = b; out[corners + 2] = c;
    corners += 3;
  }
  return { ...taken(mesh, kept, vertices), index: out.slice(0, corners), count: vertices };
}

// The numbers of these vertices alone, in one block.
function taken(mesh, kept, vertices) {
  const made = {};
  for (const [name, size] of [["place", 3], ["facing", 4], ["paint", 4], ["shine", 4], ["bounced", 4], ["soft", 4]]) {
    const from = mesh[name], to = made[name] = new from.constructor(size * vertices);
    for (let i = 0, at = 0; i < vertices; i++) for (let k = 0, start = size * kept[i]; k < size; k++) to[at++] = from[start + k];
  }
  return made;
}
