// Rays against the mesh: which place of the surface is under the pointer, and whether a place is hidden.
import { add, clamp, dot, norm, scaled, unit } from "./vectors.js";
import { facts, inPhoto, toPage, toWorld } from "./scene.js";
import { cameraNow, stage, view } from "./state.js";

const LEAST_FACING = 0.15;            // cosine: the middle of surface.frag's share of a photo's own pixels
let solid = null;
export const pickFrom = (mesh) => { solid = mesh; };

// The nearest hit of a ray, [distance, triangle, u, v], or null [Moeller and Trumbore 1997].
function hit(origin, way) {
  const { place, index, paint } = solid, [ox, oy, oz] = origin, [dx, dy, dz] = way;
  let best = Infinity, found = null;
  const isCut = stage.guess === "cut", crop = stage.crop && [toPage(stage.crop.low), toPage(stage.crop.high)];
  for (let i = 0; i < index.length; i += 3) {
    const a = 3 * index[i], b = 3 * index[i + 1], c = 3 * index[i + 2];
    const ax = place[a], ay = place[a + 1], az = place[a + 2];
    const ex = place[b] - ax, ey = place[b + 1] - ay, ez = place[b + 2] - az, fx = place[c] - ax, fy = place[c + 1] - ay, fz = place[c + 2] - az;
    const px = dy * fz - dz * fy, py = dz * fx - dx * fz, pz = dx * fy - dy * fx, det = ex * px + ey * py + ez * pz;
    if (Math.abs(det) < 1e-14) continue;
    const tx = ox - ax, ty = oy - ay, tz = oz - az, u = (tx * px + ty * py + tz * pz) / det;
    if (u < 0 || u > 1) continue;
    const qx = ty * ez - tz * ey, qy = tz * ex - tx * ez, qz = tx * ey - ty * ex, v = (dx * qx + dy * qy + dz * qz) / det;
    if (v < 0 || u + v > 1) continue;
    const t = (fx * qx + fy * qy + fz * qz) / det;
    if (t <= 1e-4 || t >= best) continue;
    if (isCut && paint[4 * index[i] + 3] < 64) continue;
    if (crop && [0, 1, 2].some((k) => origin[k] + t * way[k] < crop[0][k] || origin[k] + t * way[k] > crop[1][k])) continue;
    best = t;
    found = [t, i, u, v];
  }
  return found;
}

// The place and normal (world) of the surface at a point of the window, px; null where there is none.
export function pick(x, y, width, height) {
  const camera = cameraNow(), side = Math.min(width, height), f = view.focal * side;
  const a = (x - width / 2 - view.shift[0] * side) / f, b = (y - height / 2 - view.shift[1] * side) / f;
  const way = unit(add(add(camera.forward, camera.right, a), camera.down, b)), found = hit(camera.eye, way);
  if (!found) return null;
  const [t, i, u, v] = found, shares = [1 - u - v, u, v], normal = [0, 0, 0];
  for (let k = 0; k < 3; k++) for (let axis = 0; axis < 3; axis++) normal[axis] += shares[k] * solid.facing[4 * solid.index[i + k] + axis];
  return { at: toWorld(add(camera.eye, way, t)), normal: unit(normal), known: solid.paint[4 * solid.index[i] + 3] / 255 };
}

// Whether the surface hides a place (world) from the eye.
export function isHidden(place) {
  const camera = cameraNow(), way = add(toPage(place), camera.eye, -1), away = norm(way), found = hit(camera.eye, scaled(way, 1 / away));
  return found !== null && found[0] < away - 0.01 - 2 * facts.spacing / facts.radius;
}

// The cameras whose photos show a place (world): number, and the angle between the surface's normal and the sight, degrees.
// The one that shows it largest comes first; grazing sight does not count, as it does not for colours.
export function camerasThatShow(place, normal) {
  const lift = facts.spacing / facts.radius, from = add(toPage(place), normal, lift);
  return facts.cameras.flatMap((camera, number) => {
    const way = add(toPage(camera.eye), from, -1), away = norm(way), facing = dot(normal, way) / away;
    if (facing < LEAST_FACING || !inPhoto(camera, from)) return [];
    const found = hit(from, scaled(way, 1 / away));
    return found && found[0] < away ? [] : [{ number, angle: Math.acos(Math.min(facing, 1)) * 180 / Math.PI, size: facing / away ** 2 }];
  }).sort((a, b) => b.size - a.size);
}

// One sigma of a picked place, world length: half a pixel of the pointer on the surface, by how obliquely it is seen.
export function pointingSigma(place, normal, width, height) {
  const camera = cameraNow(), away = norm(add(toPage(place), camera.eye, -1)) * facts.radius;
  const facing = clamp(Math.abs(dot(normal, unit(add(toPage(place), camera.eye, -1)))), 0.1, 1);
  return 0.5 * away / (view.focal * Math.min(width, height)) / facing;
}
