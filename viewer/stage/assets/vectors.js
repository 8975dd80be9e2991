// Vectors and matrices. Matrices are column by column, as WebGL wants them.

export const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
export const scaled = (a, s) => a.map((x) => x * s);
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const norm = (a) => Math.hypot(...a);
export const unit = (a) => { const n = norm(a); return a.map((x) => x / n); };
export const clamp = (x, low, high) => Math.min(Math.max(x, low), high);
export const onSphere = (azimuth, elevation) => [Math.cos(elevation) * Math.cos(azimuth), Math.cos(elevation) * Math.sin(azimuth), Math.sin(elevation)];
export const GOLDEN = 0.61803398875;  // of a turn, between samples that come one after the other
export const halton = (i, b) => { let f = 1, r = 0; for (; i > 0; i = Math.floor(i / b)) { f /= b; r += f * (i % b); } return r; };

// Axes of somebody who stands at `eye`, looks at `target` and holds the head upright.
export function axesTowards(eye, target) {
  const forward = unit(add(target, eye, -1));
  const level = Math.abs(forward[2]) > 0.9999 ? [0, 1, 0] : [0, 0, 1];
  const right = unit(cross(forward, level));
  return { eye, forward, right, down: cross(forward, right) };
}

// World to clip space of a pinhole. Focal lengths and middle are in halves of the picture's sides; y of clip is up.
export function clipFrom({ eye, right, down, forward }, fx, fy, mx, my, near, far) {
  const a = (far + near) / (far - near), b = -2 * far * near / (far - near), m = new Float32Array(16);
  for (let i = 0; i < 3; i++) {
    m[4 * i] = fx * right[i] + mx * forward[i];
    m[4 * i + 1] = -fy * down[i] - my * forward[i];
    m[4 * i + 2] = a * forward[i];
    m[4 * i + 3] = forward[i];
  }
  const minusEye = scaled(eye, -1);
  m[12] = fx * dot(right, minusEye) + mx * dot(forward, minusEye);
  m[13] = -fy * dot(down, minusEye) - my * dot(forward, minusEye);
  m[14] = a * dot(forward, minusEye) + b;
  m[15] = dot(forward, minusEye);
  return m;
}
