// The passes: surface (G-buffer), depth (shadow map), blur, light, show, lines. Each takes where it draws and from where.
import { add, axesTowards, clipFrom, cross, dot, norm, unit } from "./vectors.js";
import { facts, toPage } from "./scene.js";
import { coarser } from "./coarse.js";
import { bind, flat, gl, onePixel, pictureTexture, program, target } from "./gpu.js";
import { tiles } from "./tiles.js";
import { LOOKS, shown, stage, view } from "./state.js";

const SHADOW_SIDE = 1024, SHADOW_MOVING = 512;  // px of the shadow map
const OBJECT = 1.05;                 // radius of the sphere that holds the object, with a margin
const CELLS = { surface: 80, shadow: 48 };  // along the object's longest side, in motion
const FINE = 40_000;                 // corners: a mesh of fewer is drawn whole
const OPEN_GROUND = 60;              // half the side of the drawn ground
export const pass = {};
const made = {};
let vao = null, groundVao = null, lineVao = null, lineBuffer = null, index = null, seenClip = null;

export function preparePasses(mesh, pictures) {
  Object.assign(made, {
    surface: program("surface.vert", "surface.frag"), depth: program("surface.vert", "depth.frag"),
    blur: program("full.vert", "blur.frag"),
    show: program("full.vert", "show.frag"), lines: program("lines.vert", "lines.frag"),
  });
  vao = gl.createVertexArray();
  gl.bindVertexArray(vao);
  buffer(0, mesh.place, 3, gl.FLOAT, false);
  buffer(1, mesh.facing, 4, gl.SHORT, true);
  buffer(2, mesh.paint, 4, gl.UNSIGNED_BYTE, true);
  buffer(3, mesh.shine, 4, gl.UNSIGNED_BYTE, true);
  const isSmall = mesh.index.length <= FINE;
  index = { whole: indexBuffer(mesh.index) };
  for (const [name, cells] of Object.entries(CELLS)) index[name] = isSmall ? index.whole : indexBuffer(coarser(mesh, cells));
  const z = (facts.groundHeight - facts.centre[2]) / facts.radius, s = OPEN_GROUND;
  groundVao = gl.createVertexArray();
  gl.bindVertexArray(groundVao);
  buffer(0, new Float32Array([-s, -s, z, s, -s, z, -s, s, z, s, s, z]), 3, gl.FLOAT, false);
  lineVao = gl.createVertexArray();
  gl.bindVertexArray(lineVao);
  lineBuffer = gl.createBuffer();
  gl.bindVertexArray(null);
  pass.shadow = target(SHADOW_SIDE, SHADOW_SIDE, [], 2);
  pass.shadowMoving = target(SHADOW_MOVING, SHADOW_MOVING, [], 2);
  pass.seen = target(SHADOW_SIDE, SHADOW_SIDE, [], 2);
  pass.object = pictureTexture(pictures.object, true);
  pass.ground = pictureTexture(pictures.ground, true);
  pass.normals = pictures.normals ? pictureTexture(pictures.normals, false) : null;
  pass.empty = onePixel(128, 128, 255, 255);
  seenClip = drawDepth(pass.seen, toPage(facts.camera.eye));
}

function indexBuffer(data) {
  const made = gl.createBuffer();
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, made);
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, data, gl.STATIC_DRAW);
  return { made, count: data.length };
}

// Draws the object's triangles, all of them or those of motion.
function drawObject(which) {
  gl.bindVertexArray(vao);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, index[which].made);
  gl.drawElements(gl.TRIANGLES, index[which].count, gl.UNSIGNED_INT, 0);
}

function buffer(at, data, size, kind, isShare) {
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
  gl.enableVertexAttribArray(at);
  gl.vertexAttribPointer(at, size, kind, isShare, 0, 0);
}

function setCut({ at }) {
  const crop = stage.crop ? [toPage(stage.crop.low), toPage(stage.crop.high)] : [[-1e9, -1e9, -1e9], [1e9, 1e9, 1e9]];
  gl.uniform3f(at("cropLow"), ...crop[0]);
  gl.uniform3f(at("cropHigh"), ...crop[1]);
  gl.uniform1i(at("cutGuess"), stage.guess === "cut" ? 1 : 0);
}

function setPhoto({ at }) {
  const { eye, axes, focal, middle, distortion, fisheye, field } = facts.camera;
  gl.uniform3f(at("cameraEye"), ...toPage(eye));
  gl.uniformMatrix3fv(at("cameraAxes"), false, axes.flat());
  gl.uniform2f(at("cameraFocal"), ...focal);
  gl.uniform2f(at("cameraMiddle"), ...middle);
  gl.uniform1fv(at("distortion[0]"), distortion);
  gl.uniform1i(at("fisheye"), fisheye ? 1 : 0);
  gl.uniform1f(at("field"), field);
}

// Draws depth as seen from a place and returns its world to clip matrix.
export function drawDepth(into, place, isMoving = false) {
  const away = Math.max(norm(place), 1.02 * OBJECT), near = Math.max(away - OBJECT, 0.02), far = away + OBJECT;
  const f = Math.max(Math.sqrt(away * away - OBJECT * OBJECT) / OBJECT, 0.2);
  const clip = clipFrom(axesTowards(place, [0, 0, 0]), f, f, 0, 0, near, far);
  gl.bindFramebuffer(gl.FRAMEBUFFER, into.frame);
  gl.viewport(0, 0, into.width, into.height);
  gl.enable(gl.DEPTH_TEST);
  gl.depthMask(true);
  gl.clear(gl.DEPTH_BUFFER_BIT);
  gl.enable(gl.POLYGON_OFFSET_FILL);
  gl.polygonOffset(1.5, 2);
  gl.useProgram(made.depth.made);
  gl.uniformMatrix4fv(made.depth.at("clip"), false, clip);
  setCut(made.depth);
  drawObject(isMoving ? "shadow" : "whole");
  gl.disable(gl.POLYGON_OFFSET_FILL);
  gl.disable(gl.DEPTH_TEST);
  return { clip, texel: 1 / into.width, lift: liftOf(f, away, into.width) + (isMoving ? 0.5 / CELLS.shadow : 0) };
}

// A shadow is looked up this far along the normal: a voxel, as Shadowgraph's own renderer does, or a texel of the map.
const liftOf = (f, away, side) => Math.max(facts.spacing / facts.radius, 2.0 * away / f / side);

// View to clip, with near and far; sizes in px.
export function viewClip(camera, width, height, jitter) {
  const away = norm(camera.eye), side = Math.min(width, height), focal = view.focal * side;
  const near = Math.max(away - 1.3 * OBJECT, 0.04 * away), far = away + 1.5 * OPEN_GROUND;
  const shift = [view.shift[0] * side + jitter[0], view.shift[1] * side + jitter[1]];
  const clip = clipFrom(camera, 2 * focal / width, 2 * focal / height, 2 * shift[0] / width, 2 * shift[1] / height, near, far);
  return { clip, near, far, focal, shift };
}

export function drawSurface(into, seen, isMoving = false) {
  const shader = made.surface, { at } = shader;
  gl.bindFramebuffer(gl.FRAMEBUFFER, into.frame);
  gl.viewport(0, 0, into.width, into.height);
  gl.enable(gl.DEPTH_TEST);
  gl.clearColor(0, 0, 0, 0);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  gl.useProgram(shader.made);
  gl.uniformMatrix4fv(at("clip"), false, seen.clip);
  setPhoto(shader);
  setCut(shader);
  gl.uniform3f(at("groundMean"), ...facts.groundMean);
  gl.uniform1i(at("hasNormals"), pass.normals ? 1 : 0);
  gl.uniform1i(at("hasFine"), tiles.has ? 1 : 0);
  gl.uniform4f(at("objectWindow"), ...facts.objectWindow);
  gl.uniformMatrix4fv(at("seenClip"), false, seenClip.clip);
  gl.uniform1f(at("lift"), seenClip.lift);
  bind(shader, [["objectPicture", pass.object], ["groundPicture", pass.ground], ["normalPicture", pass.normals || pass.empty],
    ["finePicture", tiles.picture || pass.empty], ["fineNormals", tiles.normals || pass.empty], ["fineThere", tiles.there], ["seenMap", pass.seen.depthMap]]);
  gl.uniform1i(at("isGround"), 0);
  if (stage.guess !== "cut" && !stage.crop) { gl.enable(gl.CULL_FACE); gl.cullFace(gl.BACK); }
  drawObject(isMoving ? "surface" : "whole");
  gl.disable(gl.CULL_FACE);
  gl.uniform1i(at("isGround"), 1);
  gl.bindVertexArray(groundVao);
  gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  gl.disable(gl.DEPTH_TEST);
}

export function drawBlur(surface, into, between, seen, radius) {
  const shader = made.blur, px = Math.max(0.6, radius * seen.focal / seen.away / 4);
  for (const [from, to, step] of [[surface.textures[1], between, [px, 0]], [between.textures[0], into, [0, px]]]) {
    gl.bindFramebuffer(gl.FRAMEBUFFER, to.frame);
    gl.viewport(0, 0, to.width, to.height);
    gl.useProgram(shader.made);
    gl.uniform2f(shader.at("step_"), ...step);
    gl.uniform2f(shader.at("nearFar"), seen.near, seen.far);
    gl.uniform1f(shader.at("nearby"), Math.max(radius, 0.01));
    bind(shader, [["normalMap", from], ["depthMap", surface.depthMap]]);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
}

const chosenOf = (name) => facts.materials.chosen[name];

// The shader of light with what is switched on: a software renderer compiles what it does not need for half a second.
function lightShader() {
  const chosen = shown.material ? chosenOf(shown.material) : null, look = Math.max(0, LOOKS.indexOf(shown.look));
  const isGlossy = chosen ? chosen.lobes.some((x) => x > 0) : Boolean(facts.gloss);
  const says = [`#define LOOK ${look}`, ...(isGlossy && shown.look !== "clay" ? ["#define GLOSS"] : []), ...(shown.surroundings ? ["#define ROOM"] : [])].join("\n");
  return (made[says] ??= program("full.vert", "light.frag", says));
}

function setMaterial({ at }) {
  const chosen = shown.material ? chosenOf(shown.material) : null, own = facts.gloss ? facts.gloss.lobes.flat() : [];
  const lobes = new Float32Array(108);
  lobes.set(chosen ? chosen.lobes : own);
  gl.uniform1fv(at("lobes[0]"), lobes);
  gl.uniform1i(at("glossy"), chosen ? 1 : own.length / 27);
  gl.uniform1fv(at("lobeSharpness[0]"), facts.materials.sharpness);
  gl.uniform1fv(at("lobeFacing[0]"), facts.materials.facing);
  gl.uniform3f(at("chosenAlbedo"), ...(chosen && chosen.albedo ? chosen.albedo : [-1, -1, -1]));
  gl.uniform1i(at("chosenGloss"), chosen ? 1 : 0);
}

export function drawLight(into, surface, blurred, seen, light, sample, mode) {
  const shader = lightShader(), { at } = shader, camera = seen.camera;
  gl.bindFramebuffer(gl.FRAMEBUFFER, into.frame);
  gl.viewport(0, 0, into.width, into.height);
  gl.useProgram(shader.made);
  setPhoto(shader);
  setMaterial(shader);
  for (const name of ["eye", "right", "down", "forward"]) gl.uniform3f(at(name), ...camera[name]);
  gl.uniform2f(at("size"), into.width, into.height);
  gl.uniform2f(at("shift"), ...seen.shift);
  gl.uniform1f(at("focal"), seen.focal);
  gl.uniform2f(at("nearFar"), seen.near, seen.far);
  gl.uniformMatrix4fv(at("shadowClip"), false, light.shadow.clip);
  gl.uniform1f(at("lift"), light.shadow.lift);
  gl.uniform1f(at("texel"), light.shadow.texel);
  gl.uniform1i(at("taps"), mode.encoded ? 4 : 1);
  gl.uniform3f(at("lamp"), ...light.place);
  gl.uniform1f(at("strength"), light.strength);
  gl.uniform1f(at("ambient"), light.ambient);
  gl.uniform3f(at("background"), ...facts.background);
  gl.uniform2f(at("fade"), ...facts.fade);
  gl.uniform1f(at("gain"), shown.look === "curvature" ? 0.25 * shown.gain : shown.look === "unsharp" ? 1.5 * shown.gain : 2 * shown.gain);
  gl.uniform1f(at("sharpness"), shown.sharpness);
  gl.uniform1f(at("worldPx"), seen.away / seen.focal);
  gl.uniform1i(at("markGuess"), stage.guess === "marked" ? 1 : 0);
  gl.uniform1i(at("smoothed"), stage.smooth > 0 ? 1 : 0);
  gl.uniform1f(at("turn"), facts.home.azimuth);
  gl.uniform1f(at("wipe"), shown.photo && pass.photo ? shown.wipe * into.width : -1);
  gl.uniform1i(at("encoded"), mode.encoded ? 1 : 0);
  gl.uniform1f(at("share"), 1 / (sample + 1));
  bind(shader, [["albedoMap", surface.textures[0]], ["normalMap", surface.textures[1]], ["glossMap", surface.textures[2]],
    ["blurMap", blurred ? blurred.textures[0] : surface.textures[1]], ["depthMap", surface.depthMap],
    ["shadowMap", light.map.depthMap], ["photo", pass.photo || pass.empty], ["before", mode.before || pass.empty]]);
  gl.drawArrays(gl.TRIANGLES, 0, 3);
}

export function drawShow(texture, sx, sy, full) {
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  gl.viewport(0, 0, ...full);
  gl.useProgram(made.show.made);
  bind(made.show, [["picture", texture]]);
  gl.uniform2f(made.show.at("scale"), sx, sy);
  gl.drawArrays(gl.TRIANGLES, 0, 3);
}

// Lines in space over the picture: seven numbers per end, place and colour.
export function drawLines(ends, seen, depthMap, full) {
  if (!ends.length) return;
  const data = new Float32Array(ends);
  gl.bindVertexArray(lineVao);
  gl.bindBuffer(gl.ARRAY_BUFFER, lineBuffer);
  gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 28, 0);
  gl.enableVertexAttribArray(1);
  gl.vertexAttribPointer(1, 4, gl.FLOAT, false, 28, 12);
  gl.useProgram(made.lines.made);
  gl.uniformMatrix4fv(made.lines.at("clip"), false, seen.clip);
  gl.uniform2f(made.lines.at("full"), ...full);
  bind(made.lines, [["depthMap", depthMap]]);
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
  gl.drawArrays(gl.LINES, 0, data.length / 7);
  gl.disable(gl.BLEND);
  gl.bindVertexArray(null);
}

// A point of the lamp's disc, which faces the object.
export function lampPoint(place, radius, reach, angle) {
  if (!(radius > 0)) return place;
  const axis = unit(place), level = Math.abs(axis[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0], across = unit(cross(axis, level));
  const r = radius * reach;
  return add(add(place, across, r * Math.cos(angle)), cross(axis, across), r * Math.sin(angle));
}

export const pictureDistance = (p, camera) => dot(add(p, camera.eye, -1), camera.forward);
export const gBufferFormats = () => [[gl.RGBA8, gl.UNSIGNED_BYTE], [gl.RGBA16F, gl.HALF_FLOAT], [gl.RGBA8, gl.UNSIGNED_BYTE]];
