// The photo's own pixels, in tiles: each comes when the view has come close enough to show more than the first picture.
import { facts, loadPicture } from "./scene.js";
import { flat, gl } from "./gpu.js";

const AT_ONCE = 3;           // pictures that are decoded at a time
const SHARPER = 1.1;         // times the first picture's pixels: below, tiles would show nothing new
export const tiles = { picture: null, normals: null, there: null, has: false, came: 0 };
const asked = new Set();
let underWay = 0, first = null;

export function tilesBeyond(firstWidth) { first = firstWidth; }

// Asks for the tiles in a part of the object's window (shares: left, top, right, bottom) if a screen shows them so large.
export function wantTiles(part, pxAcross, arrived) {
  const stock = facts.addresses.tiles;
  if (!stock || pxAcross < SHARPER * first) return;
  const { side, size: [width, height] } = stock, across = Math.ceil(width / side);
  if (!tiles.has) openTiles(width, height, side);
  for (let i = 0; i < stock.albedo.length && underWay < AT_ONCE; i++) {
    const left = (i % across) * side / width, top = Math.floor(i / across) * side / height;
    const isWanted = left < part[2] && left + side / width > part[0] && top < part[3] && top + side / height > part[1];
    if (isWanted && !asked.has(i)) { asked.add(i); fetchTile(i, across, stock, arrived); }
  }
}

function openTiles(width, height, side) {
  const make = (internal) => { const texture = flat(gl.LINEAR); gl.texStorage2D(gl.TEXTURE_2D, 1, internal, width, height); return texture; };
  tiles.picture = make(gl.SRGB8_ALPHA8);
  tiles.normals = make(gl.RGBA8);
  tiles.there = flat(gl.NEAREST);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.R8, width, height, 0, gl.RED, gl.UNSIGNED_BYTE, new Uint8Array(width * height));
  tiles.has = true;
}

async function fetchTile(i, across, stock, arrived) {
  underWay++;
  try {
    const [albedo, normals] = await Promise.all([loadPicture(stock.albedo[i]), loadPicture(stock.normals[i])]);
    const x = (i % across) * stock.side, y = Math.floor(i / across) * stock.side;
    gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
    for (const [texture, picture] of [[tiles.picture, albedo], [tiles.normals, normals]]) {
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, x, y, gl.RGBA, gl.UNSIGNED_BYTE, picture);
    }
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.bindTexture(gl.TEXTURE_2D, tiles.there);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, x, y, albedo.width, albedo.height, gl.RED, gl.UNSIGNED_BYTE, new Uint8Array(albedo.width * albedo.height).fill(255));
    tiles.came++;
  } catch { asked.delete(i); }
  underWay--;
  arrived();
}
