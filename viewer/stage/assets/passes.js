// The passes: surface (G-buffer), depth (shadow map), blur, light, show, lines. Each takes where it draws and from where.
import { add, axesTowards, clipFrom, cross, norm, unit } from "./vectors.js";
import { cameraOf, coarser, facts, groundPlace, toPage } from "./scene.js";
import { bind, gl, pictureTexture, plainDepth, program, shareTexture, target } from "./gpu.js";
import { LOOKS, home, isBelow, shown, stage, view } from "./state.js";

const SHADOW_SIDE = 1024, SHADOW_MOVING = 512;  // px of the shadow map
const OBJECT = 1.05;                 // radius of the sphere that holds the object, with a margin
const CELLS = { surface: 64, shadow: 40 };  // along the object's longest side, in motion
const FINE = 40_000;                 // corners: a mesh of fewer is drawn whole
const OPEN_GROUND = 60;              // half the side of the drawn ground
const SAME_PLACE = 1e-3;             // radii of the object: an eye this near to the photo's camera sees what the photo shows
export const pass = { isCoarse: null };
const made = {};
let meshes = null, groundVao = null, lineVao = null, lineBuffer = null, seenOf = "", seenClip = null;

// A program with what is switched on: a software renderer pays for every branch, and half a second for compiling all.
function shaderOf(vertex, fragment, ...flags) {
  const on = flags.filter(Boolean);
  return (made[`${vertex} ${fragment} ${on}`] ??= program(vertex, fragment, on.map((flag) => `#define ${flag}`).join("\n")));
}

// Compiles what the first picture needs, while its parts are still on their way.
export function openPasses() {
  shaderOf("surface.vert", "depth.frag", "PLAIN");
  for (const kind of ["", "GROUND"]) surfaceShader(kind, true);
  lightShader(true, false);
  shaderOf("full.vert", "show.frag", "SAME");
}

export function preparePasses(mesh, pictures) {
  const isSmall = mesh.index.length <= FINE, whole = vertexArray(mesh);
  meshes = { whole };
  for (const [name, cells] of Object.entries(CELLS)) meshes[name] = isSmall ? whole : vertexArray(coarser(mesh, cells));
  const z = groundPlace, s = OPEN_GROUND;
  groundVao = gl.createVertexArray();
  gl.bindVertexArray(groundVao);
  buffer(0, new Float32Array([-s, -s, z, s, -s, z, -s, s, z, s, s, z]), 3, gl.FLOAT, false);
  lineVao = gl.createVertexArray();
  gl.bindVertexArray(lineVao);
  lineBuffer = gl.createBuffer();
  gl.bindVertexArray(null);
  pass.shadow = target(SHADOW_SIDE, SHADOW_SIDE, [], 2);
  pass.shadowMoving = target(SHADOW_MOVING, SHADOW_MOVING, [], 2);
  pass.object = pictureTexture(pictures.object, true);
  pass.objectPx = Math.max(pictures.object.width, pictures.object.height);
  pass.ground = pictureTexture(pictures.ground, true);
  pass.groundSky = shareTexture(mesh.ground.sky, mesh.ground.side);
  pass.normals = pictures.normals ? pictureTexture(pictures.normals, false) : null;
}

function vertexArray(mesh) {
  const array = gl.createVertexArray();
  gl.bindVertexArray(array);
  buffer(0, mesh.place, 3, gl.FLOAT, false);
  buffer(1, mesh.facing, 4, gl.SHORT, true);
  buffer(2, mesh.paint, 4, gl.UNSIGNED_BYTE, true);
  buffer(3, mesh.shine, 4, gl.UNSIGNED_BYTE, true);
  buffer(4, mesh.bounced, 4, gl.BYTE, true);
  buffer(5, mesh.soft, 4, gl.UNSIGNED_BYTE, true);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, mesh.index, gl.STATIC_DRAW);
  return { array, count: mesh.index.length };
}

// Draws the object's triangles, all of them or those of motion.
function drawObject(which) {
  gl.bindVertexArray(meshes[which].array);
  gl.drawElements(gl.TRIANGLES, meshes[which].count, gl.UNSIGNED_INT, 0);
}

function buffer(at, data, size, kind, isShare) {
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
  gl.enableVertexAttribArray(at);
  gl.vertexAttribPointer(at, size, kind, isShare, 0, 0);
}

const isCut = () => stage.guess === "cut" || Boolean(stage.crop);

function setCut({ at }) {
  const crop = stage.crop ? [toPage(stage.crop.low), toPage(stage.crop.high)] : [[-1e9, -1e9, -1e9], [1e9, 1e9, 1e9]];
  gl.uniform3f(at("cropLow"), ...crop[0]);
  gl.uniform3f(at("cropHigh"), ...crop[1]);
  gl.uniform1i(at("cutGuess"), stage.guess === "cut" ? 1 : 0);
}

// Tells a shader where a photo of this camera shows a place; the first is that of the run's pictures.
function setPhoto({ at }, camera = facts.cameras[0]) {
  const { eye, axes, focal, middle, distortion, fisheye, field } = camera;
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
  const shader = isCut() ? shaderOf("surface.vert", "depth.frag") : shaderOf("surface.vert", "depth.frag", "PLAIN");
  gl.useProgram(shader.made);
  gl.uniformMatrix4fv(shader.at("clip"), false, clip);
  if (isCut()) setCut(shader);
  drawObject(isMoving ? "shadow" : "whole");
  gl.disable(gl.POLYGON_OFFSET_FILL);
  gl.disable(gl.DEPTH_TEST);
  return { clip, f, near, far, lift: liftOf(f, away, into.width) + (isMoving ? 0.5 / CELLS.shadow : 0) };
}

// A shadow is looked up this far along the normal: a voxel, as Shadowgraph's own renderer does, or a texel of the map.
const liftOf = (f, away, side) => Math.max(facts.spacing / facts.radius, 2.0 * away / f / side);

// View to clip, with near and far; sizes in px.
export function viewClip(camera, width, height, jitter) {
  const away = norm(camera.eye), side = Math.min(width, height), focal = view.focal * side;
  const near = 0.04 * away, far = away + 1.5 * OPEN_GROUND;
  const shift = [view.shift[0] * side + jitter[0], view.shift[1] * side + jitter[1]];
  const clip = clipFrom(camera, 2 * focal / width, 2 * focal / height, 2 * shift[0] / width, 2 * shift[1] / height, near, far);
  return { clip, near, far, focal, shift };
}

// What the photo's camera sees, made when the view first leaves its place, and again when something is cut away.
function seenFromPhoto() {
  const key = JSON.stringify([stage.crop, stage.guess === "cut"]);
  pass.seen ??= target(SHADOW_SIDE, SHADOW_SIDE, [], 2);
  if (seenOf !== key) { seenClip = drawDepth(pass.seen, toPage(facts.cameras[0].eye)); seenOf = key; }
}

function surfaceShader(kind, isHome) {
  const isGround = kind === "GROUND";
  return shaderOf("surface.vert", "surface.frag", kind, facts.gloss && "GLOSS", ...(isGround ? [] : [
    isCut() && "CUT", facts.addresses.normals && "NORMALS", pass.fine && "FINE", isHome && "HOME"]));
}

// Fewer pixels of the pictures are read while something moves.
function readPictures(isCoarse) {
  if (pass.isCoarse === isCoarse) return;
  pass.isCoarse = isCoarse;
  for (const texture of [pass.object, pass.ground, pass.normals]) if (texture) {
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, isCoarse ? gl.LINEAR_MIPMAP_NEAREST : gl.LINEAR_MIPMAP_LINEAR);
  }
}

export function drawSurface(into, seen, isMoving = false) {
  const isHome = norm(add(seen.camera.eye, toPage(facts.cameras[0].eye), -1)) < SAME_PLACE;
  if (!isHome) seenFromPhoto();
  readPictures(isMoving);
  gl.bindFramebuffer(gl.FRAMEBUFFER, into.frame);
  gl.viewport(0, 0, into.width, into.height);
  gl.enable(gl.DEPTH_TEST);
  gl.clearBufferfv(gl.COLOR, 1, [0, 0, 0, 0]);  // nothing is anywhere; what is nowhere needs no colour
  gl.clearBufferfv(gl.DEPTH, 0, [1]);
  const object = surfaceShader("", isHome), { at } = object;
  gl.useProgram(object.made);
  gl.uniformMatrix4fv(at("clip"), false, seen.clip);
  setPhoto(object);
  gl.uniform1i(at("isBelow"), isBelow() ? 1 : 0);
  gl.uniform1f(at("bounceScale"), facts.parts.bounce.scale);
  gl.uniform4f(at("objectWindow"), ...facts.objectWindow);
  const pictures = [["objectPicture", pass.object]];
  if (pass.normals) pictures.push(["normalPicture", pass.normals]);
  if (pass.fine) pictures.push(["finePicture", pass.fine], ["fineNormals", pass.fineNormals]);
  if (!isHome) {
    gl.uniformMatrix4fv(at("seenClip"), false, seenClip.clip);
    gl.uniform1f(at("lift"), seenClip.lift);
    pictures.push(["seenMap", pass.seen.depthMap]);
  }
  bind(object, pictures);
  if (isCut()) setCut(object); else { gl.enable(gl.CULL_FACE); gl.cullFace(gl.BACK); }
  drawObject(isMoving ? "surface" : "whole");
  gl.disable(gl.CULL_FACE);
  if (seen.camera.eye[2] > groundPlace) drawGround(seen, isHome);
  gl.disable(gl.DEPTH_TEST);
}

function drawGround(seen, isHome) {
  const ground = surfaceShader("GROUND", isHome);
  gl.useProgram(ground.made);
  gl.uniformMatrix4fv(ground.at("clip"), false, seen.clip);
  setPhoto(ground);
  gl.uniform3f(ground.at("groundMean"), ...facts.groundMean);
  gl.uniform1f(ground.at("groundHalf"), facts.groundHalf);
  bind(ground, [["groundPicture", pass.ground], ["groundSky", pass.groundSky]]);
  gl.bindVertexArray(groundVao);
  gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
}

export function drawBlur(surface, into, between, seen, radius) {
  const shader = shaderOf("full.vert", "blur.frag"), px = Math.max(0.6, radius * seen.focal / seen.away / 4);
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

function lightShader(isMoving, isWiped) {
  const chosen = shown.material ? chosenOf(shown.material) : null, look = Math.max(0, LOOKS.indexOf(shown.look));
  const glossy = shown.look === "clay" ? 0 : chosen ? Number(chosen.lobes.some((x) => x > 0)) : facts.gloss ? facts.gloss.lobes.length : 0;
  return shaderOf("full.vert", "light.frag", `LOOK ${look}`, glossy && `GLOSS ${glossy}`, shown.surroundings && "ROOM",
    stage.smooth > 0 && "BLUR", isWiped && "WIPE", isMoving && "MOVING");
}

function setMaterial({ at }) {
  const chosen = shown.material ? chosenOf(shown.material) : null, own = facts.gloss ? facts.gloss.lobes.flat() : [];
  const lobes = new Float32Array(108);
  lobes.set(chosen ? chosen.lobes : own);
  gl.uniform1fv(at("lobes[0]"), lobes);
  gl.uniform1fv(at("lobeSharpness[0]"), facts.materials.sharpness);
  gl.uniform1fv(at("lobeFacing[0]"), facts.materials.facing);
  gl.uniform3f(at("chosenAlbedo"), ...(chosen && chosen.albedo ? chosen.albedo : [-1, -1, -1]));
  gl.uniform1i(at("chosenGloss"), chosen ? 1 : 0);
}

// Lights the surface: for the screen at once where `before` is left out, else as one sample of a mean.
export function drawLight(into, surface, blurred, seen, light, sample = 0, before = null) {
  const isWiped = Boolean(shown.photo && pass.photo), shader = lightShader(!before, isWiped), { at } = shader, camera = seen.camera;
  gl.bindFramebuffer(gl.FRAMEBUFFER, into.frame);
  gl.viewport(0, 0, into.width, into.height);
  gl.useProgram(shader.made);
  setMaterial(shader);
  for (const name of ["eye", "right", "down", "forward"]) gl.uniform3f(at(name), ...camera[name]);
  gl.uniform2f(at("size"), into.width, into.height);
  gl.uniform2f(at("shift"), ...seen.shift);
  gl.uniform1f(at("focal"), seen.focal);
  gl.uniform2f(at("nearFar"), seen.near, seen.far);
  gl.uniformMatrix4fv(at("shadowClip"), false, light.shadow.clip);
  gl.uniform1f(at("lift"), light.shadow.lift);
  gl.uniform4f(at("shadowView"), light.shadow.near, light.shadow.far, light.shadow.f, light.reach);
  gl.uniform1f(at("numbered"), sample);
  gl.uniform3f(at("lamp"), ...light.place);
  gl.uniform1f(at("strength"), light.strength);
  gl.uniform1f(at("ambient"), light.ambient);
  gl.uniform3f(at("background"), ...facts.background);
  gl.uniform2f(at("fade"), ...facts.fade);
  gl.uniform1f(at("gain"), shown.look === "curvature" ? 0.25 * shown.gain : shown.look === "unsharp" ? 1.5 * shown.gain : 2 * shown.gain);
  gl.uniform1f(at("sharpness"), shown.sharpness);
  gl.uniform1f(at("worldPx"), seen.away / seen.focal);
  gl.uniform1i(at("markGuess"), stage.guess === "marked" ? 1 : 0);
  gl.uniform1f(at("turn"), home.azimuth);
  const maps = [["albedoMap", surface.textures[0]], ["normalMap", surface.textures[1]], ["softMap", surface.textures[2]],
    ["depthMap", surface.depthMap], ["shadowMap", light.map.depthMap], ["shadowDepth", light.map.depthMap]];
  if (surface.textures[3]) maps.push(["glossMap", surface.textures[3]]);
  if (blurred) maps.push(["blurMap", blurred.textures[0]]);
  if (isWiped) {
    setPhoto(shader, cameraOf(shown.photo));
    gl.uniform1f(at("wipe"), shown.wipe * into.width);
    maps.push(["photo", pass.photo]);
  }
  if (before) {
    gl.uniform1f(at("share"), 1 / (sample + 1));
    maps.push(["before", before]);
  }
  bind(shader, maps);
  plainDepth(maps.findIndex(([name]) => name === "shadowDepth"), () => gl.drawArrays(gl.TRIANGLES, 0, 3));
}

export function drawShow(texture, sx, sy, full) {
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  gl.viewport(0, 0, ...full);
  const shader = shaderOf("full.vert", "show.frag", sx === 1 && sy === 1 && "SAME");
  gl.useProgram(shader.made);
  bind(shader, [["picture", texture]]);
  gl.uniform2f(shader.at("scale"), sx, sy);
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
  const shader = shaderOf("lines.vert", "lines.frag");
  gl.useProgram(shader.made);
  gl.uniformMatrix4fv(shader.at("clip"), false, seen.clip);
  gl.uniform2f(shader.at("full"), ...full);
  bind(shader, [["depthMap", depthMap]]);
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

export const gBufferFormats = () => [[gl.RGBA8, gl.UNSIGNED_BYTE], [gl.RGBA16F, gl.HALF_FLOAT],
  [gl.RGBA32UI, gl.UNSIGNED_INT, gl.RGBA_INTEGER], ...(facts.gloss ? [[gl.RGBA8, gl.UNSIGNED_BYTE]] : [])];
