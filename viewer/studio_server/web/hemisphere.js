// The lights seen from above: the object in the middle, the horizon at the rim, the camera below. Missing sectors glow.

import { h } from "./dom.js";

const SECTORS = 8, LOW = 60; // degrees: lights above it say little about the sides
const R = 84;

/** `lights`: [{azimuth, elevation, used, photo}] in degrees, azimuth from the camera, positive to its right. */
export function dome(lights) {
  const used = lights.filter((light) => light.used && light.elevation < LOW);
  const missing = [...Array(SECTORS).keys()].filter((k) => !used.some((light) => sector(light.azimuth) === k));
  return h("svg", { class: "dome", viewBox: "-100 -100 200 200", role: "img",
    "aria-label": `${lights.length} lights seen from above; ${missing.length ? `none from ${missing.map((k) => SIDES[k]).join(", ")}` : "all sides are lit"}` },
    missing.map((k) => h("path", { class: "missing", d: wedge(k) })),
    [30, 60, 90].map((angle) => h("circle", { class: "rim", cx: 0, cy: 0, r: (R * angle) / 90 })),
    h("text", { x: 0, y: 97, "text-anchor": "middle" }, "camera"),
    lights.map((light) => {
      const [x, y] = place(light);
      return h("circle", { class: light.used ? "light" : "unused", cx: x.toFixed(1), cy: y.toFixed(1), r: 4 });
    }));
}

const SIDES = ["the camera's side", "the camera's right", "the right", "behind, right", "behind", "behind, left", "the left", "the camera's left"];

function sector(azimuth) { return ((Math.round((azimuth * SECTORS) / 360) % SECTORS) + SECTORS) % SECTORS; }

function place({ azimuth, elevation }) {
  const reach = (R * (90 - Math.max(0, elevation))) / 90, turn = (azimuth * Math.PI) / 180;
  return [reach * Math.sin(turn), reach * Math.cos(turn)];
}

function wedge(k) {
  const step = (2 * Math.PI) / SECTORS, from = (k - 0.5) * step, to = (k + 0.5) * step;
  const inner = (R * (90 - LOW)) / 90;
  const at = (r, turn) => `${(r * Math.sin(turn)).toFixed(1)} ${(r * Math.cos(turn)).toFixed(1)}`;
  return `M ${at(inner, from)} L ${at(R, from)} A ${R} ${R} 0 0 0 ${at(R, to)} L ${at(inner, to)} A ${inner} ${inner} 0 0 1 ${at(inner, from)} Z`;
}
