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
