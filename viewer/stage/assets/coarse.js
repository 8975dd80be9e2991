// Coarser triangles for pictures in motion: vertices that share a cell become one [Rossignac and Borrel 1993].

// The index of the triangles left when the object's box has `cells` cells along its longest side.
export function coarser(mesh, cells) {
  const { place, index } = mesh, low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  for (let i = 0; i < place.length; i++) { low[i % 3] = Math.min(low[i % 3], place[i]); high[i % 3] = Math.max(high[i % 3], place[i]); }
  const step = Math.max(high[0] - low[0], high[1] - low[1], high[2] - low[2]) / cells, n = low.map((from, k) => Math.floor((high[k] - from) / step) + 1);
  const first = new Int32Array(n[0] * n[1] * n[2]).fill(-1), cell = new Int32Array(mesh.count), out = new Uint32Array(index.length);
  for (let i = 0; i < mesh.count; i++) {
    const [x, y, z] = [0, 1, 2].map((k) => Math.floor((place[3 * i + k] - low[k]) / step));
    const at = x + n[0] * (y + n[1] * z);
    if (first[at] < 0) first[at] = i;
    cell[i] = first[at];
  }
  let count = 0;
  for (let i = 0; i < index.length; i += 3) {
    const a = cell[index[i]], b = cell[index[i + 1]], c = cell[index[i + 2]];
    if (a === b || b === c || c === a) continue;
    out[count] = a; out[count + 1] = b; out[count + 2] = c;
    count += 3;
  }
  return out.slice(0, count);
}
