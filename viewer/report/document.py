"""The HTML elements of the report, which escape all text that is given to them, and its small 8-bit sRGB pictures.

Pictures are of photos, of depth and normals, and of a mesh, drawn without a graphics card.
"""

import base64
import hashlib
import html
import io
from collections.abc import Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image

from capture.photos.photo import decode_srgb, encode_srgb

if TYPE_CHECKING:  # beside a run a page shows photos only, and opens sooner without it
    import trimesh


STYLE = """
:root{--bg:#fbfaf8;--card:#fff;--text:#1d2026;--muted:#667080;--line:#dfe1e6;--accent:#d9820f;--good:#1f8a53;--bad:#c8402f}
@media (prefers-color-scheme:dark){:root{--bg:#15171b;--card:#1d2026;--text:#e8eaee;--muted:#98a1b0;--line:#353a44;
--accent:#f0a53a;--good:#4cc38a;--bad:#f2705e}}
*{box-sizing:border-box}
body{margin:0;background:var(--bg);color:var(--text);font:16px/1.55 system-ui,-apple-system,"Segoe UI",sans-serif}
main{max-width:1060px;margin:0 auto;padding:28px 20px 80px}
h1,figcaption,li{overflow-wrap:anywhere}td{overflow-wrap:break-word}header>:last-child{margin-bottom:0}
h1{font-size:1.9rem;line-height:1.2;margin:.1rem 0 .3rem}
h2{font-size:1.25rem;margin:0 0 .2rem}
.lead{color:var(--muted);margin:0 0 1rem;max-width:46rem}
section,header{background:var(--card);border:1px solid var(--line);border-radius:14px;padding:22px 24px;margin:0 0 18px}
header .tag{font-size:.8rem;letter-spacing:.06em;text-transform:uppercase;color:var(--muted)}
.verdict{font-size:1.1rem;margin:.2rem 0 1rem;border-left:4px solid var(--good);padding-left:.7rem}
.verdict.warn{border-color:var(--accent)}.verdict.bad{border-color:var(--bad)}
.facts{display:flex;flex-wrap:wrap;gap:14px 34px;margin:0 0 1rem}.facts>div{min-width:150px}
.facts b{display:block;font-size:1.35rem;line-height:1.2}
.facts span{color:var(--muted);font-size:.86rem;max-width:15rem;display:block}
.row{display:flex;flex-wrap:wrap;gap:18px}.row>*{flex:1 1 280px;min-width:0}
.row.wide-first>*:first-child{flex:2 1 420px}
.row.wide-first{align-items:center}
figure{margin:0}figcaption{color:var(--muted);font-size:.86rem;margin-top:.35rem}
img,svg{display:block;width:100%;height:auto}img{border-radius:8px}
svg{margin:0 auto}
svg text{fill:var(--muted);font-family:inherit;paint-order:stroke;stroke:var(--card);stroke-width:3px}
.scroll{overflow-x:auto}table{border-collapse:collapse;width:100%;font-size:.92rem;font-variant-numeric:tabular-nums}
th,td{text-align:left;padding:6px 12px 6px 0;border-bottom:1px solid var(--line);vertical-align:top}
th{color:var(--muted);font-weight:600}th::first-letter{text-transform:uppercase}
td.n,th.n{text-align:right;white-space:nowrap}.legend{margin:.5rem 0 1rem}
.grid{display:grid;grid-template-columns:repeat(auto-fill,minmax(128px,1fr));gap:12px}
.grid figcaption{font-size:.76rem;line-height:1.3;overflow-wrap:anywhere}
.dropped img{filter:grayscale(1);opacity:.55}.dropped figcaption b{color:var(--bad)}
.key{display:inline-flex;align-items:center;gap:6px;margin-right:16px;font-size:.86rem;color:var(--muted)}
.key i{width:18px;height:3px;border-radius:2px;display:inline-block}
ul{margin:.2rem 0;padding-left:1.2rem}code{font-size:.88em;overflow-wrap:anywhere}
summary{cursor:pointer;color:var(--muted)}
@media (max-width:560px){table.words tr{display:block;padding:8px 0;border-bottom:1px solid var(--line)}
table.words th{display:none}table.words td{display:block;padding:0;border:0}table.words td:first-child{font-weight:600}}
@media print{body{background:#fff}section,header{break-inside:avoid}}
"""
Picture = UInt8[np.ndarray, "height width channels"]  # RGB, or RGBA where it has no background

JPEG_QUALITY = 86
MARGIN = 1.04  # of a picture's sides over a mesh that just fits in
OVERSAMPLING = 2  # a mesh is drawn this much larger, then averaged: smooth outlines
FROM_AFAR = 1000.0  # heights of the picture between viewer and mesh: rays are parallel to a tenth of a pixel
PLAIN = (190, 190, 196)  # of a mesh without colours
KEY, FILL, RIM = 0.6, 0.26, 0.12  # light from upper left, from all around, and from above
DARKER, SAME, BRIGHTER = (52, 119, 219), (236, 236, 236), (226, 74, 51)  # of a difference
STRONG_DIFFERENCE = 0.2  # of full sRGB scale: shown as full colour


def page(title: str, body: str, style: str = "", script: str = "") -> str:
    """Return a whole document. It loads nothing, and its policy forbids the browser to load anything.

    Args:
        style: more rules, after those of every page.
        script: the only one that it may run; such a page may also show pictures that lie beside it.
    """
    policy, code = "default-src 'none'; style-src 'unsafe-inline'; img-src data:", ""
    if script:
        policy, code = f"{policy} 'self'; script-src {hash_of(script)}", f"<script>{script}</script>"
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        f"<title>{html.escape(title)}</title><style>{STYLE}{style}</style></head><body><main>{body}</main>{code}</body>"
        "</html>\n"
    )


def hash_of(text: str) -> str:
    """Return the source of a script or style by its hash, for a content security policy."""
    digest = hashlib.sha256(text.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"


def section(title: str, explanation: str, body: str) -> str:
    """Return a titled part with one sentence that explains it; "" if the body is empty."""
    if not body:
        return ""
    return f'<section><h2>{html.escape(title)}</h2><p class="lead">{html.escape(explanation)}</p>{body}</section>'


def figure(picture: Picture | str, caption: str, kind: str = "") -> str:
    """Return a picture, or an SVG drawing, with its caption."""
    shown = picture if isinstance(picture, str) else f'<img src="{data_uri(picture)}" alt="{html.escape(caption)}">'
    return f'<figure class="{kind}">{shown}<figcaption>{html.escape(caption)}</figcaption></figure>'


def row(*cells: str, kind: str = "") -> str:
    """Return parts side by side where the page is wide enough. Empty ones are left out."""
    shown = [cell for cell in cells if cell]
    return f'<div class="row {kind}">{"".join(shown)}</div>' if shown else ""


def facts(values: Sequence[tuple[str, str]]) -> str:
    """Return numbers in large type, each over one short sentence that explains it."""
    if not values:
        return ""
    cells = (f"<div><b>{html.escape(v)}</b><span>{html.escape(what)}</span></div>" for v, what in values)
    return f'<div class="facts">{"".join(cells)}</div>'


def table(head: Sequence[str], rows: Sequence[Sequence[str]], numbers: Sequence[int] = ()) -> str:
    """Return a table of text. The columns `numbers` are set flush right; without any, narrow pages stack its cells."""
    if not rows:
        return ""

    def cell(tag: str, column: int, words: str) -> str:
        return f"<{tag}{' class=n' if column in numbers else ''}>{html.escape(words)}</{tag}>"

    lines = ["".join(cell("th", i, words) for i, words in enumerate(head))]
    lines += ["".join(cell("td", i, words) for i, words in enumerate(r)) for r in rows]
    kind = "" if numbers else ' class="words"'
    return f'<div class="scroll"><table{kind}>{"".join(f"<tr>{line}</tr>" for line in lines)}</table></div>'


def length_unit(unit: str) -> str:
    """Return how lengths of a world are named: `mm`, or `units` where no length is known."""
    return "mm" if unit == "mm" else "units"


def bullets(lines: Sequence[str]) -> str:
    """Return a list of sentences."""
    return f"<ul>{''.join(f'<li>{html.escape(line)}</li>' for line in lines)}</ul>" if lines else ""


def folded(title: str, body: str) -> str:
    """Return a part that a click opens."""
    return f"<details><summary>{html.escape(title)}</summary>{body}</details>" if body else ""


def jpeg(picture: UInt8[np.ndarray, "height width 3"], quality: int, is_exact: bool = False) -> bytes:
    """Return a picture as JPEG; with `is_exact` its colours are kept at full resolution, as those of normals."""
    file = io.BytesIO()
    Image.fromarray(picture).save(file, format="JPEG", quality=quality, subsampling=0 if is_exact else 2)
    return file.getvalue()


def as_address(content: bytes, kind: str) -> str:
    """Return a file as a data address."""
    return f"data:{kind};base64," + base64.b64encode(content).decode()


def data_uri(picture: Picture) -> str:
    """Return the picture as a data: address for an <img>: JPEG, or PNG if it has no background."""
    if picture.shape[-1] == 3:
        return as_address(jpeg(picture, JPEG_QUALITY), "image/jpeg")
    out = io.BytesIO()
    Image.fromarray(picture).save(out, "PNG")
    return as_address(out.getvalue(), "image/png")


def reduced(picture: Picture, width: int) -> Picture:
    """Return the picture at most `width` px wide."""
    return picture if picture.shape[1] <= width else _resized(picture, width, Image.Resampling.BOX)


def enlarged(picture: Picture, width: int) -> Picture:
    """Return the picture at least `width` px wide."""
    return picture if picture.shape[1] >= width else _resized(picture, width, Image.Resampling.BICUBIC)


def _resized(picture: Picture, width: int, how: Image.Resampling) -> Picture:
    height = max(1, round(picture.shape[0] * width / picture.shape[1]))
    return np.asarray(Image.fromarray(picture).resize((width, height), how))


def depth_picture(depth: Float[np.ndarray, "height width"], mask: Bool[np.ndarray, "height width"]) -> Picture:
    """Draw the depth of the masked pixels, from yellow at the nearest to violet at the farthest."""
    seen = mask & np.isfinite(depth)
    out = np.zeros((*depth.shape, 4), np.uint8)
    if seen.any():
        near, far = depth[seen].min(), depth[seen].max()
        level = np.round(255 * (far - depth[seen]) / max(far - near, 1e-9)).astype(np.uint8)
        out[seen, :3] = cv2.applyColorMap(level, cv2.COLORMAP_VIRIDIS).reshape(-1, 3)[:, ::-1]
        out[seen, 3] = 255
    return out


def normal_picture(normals: Float[np.ndarray, "height width 3"], mask: Bool[np.ndarray, "height width"]) -> Picture:
    """Draw the world normals of the masked pixels: red, green and blue are their x, y and z."""
    out = np.zeros((*mask.shape, 4), np.uint8)
    out[mask, :3] = np.round(127.5 * (np.clip(normals[mask], -1, 1) + 1))
    out[mask, 3] = 255
    return out


def difference_picture(one: Picture, other: Picture) -> Picture:
    """Draw the difference of two pictures of one size: red where the first is brighter, blue where it is darker."""
    gap = (one.astype(float).mean(-1) - other.astype(float).mean(-1)) / 255 / STRONG_DIFFERENCE
    amount = np.clip(np.abs(gap), 0, 1)[..., None]
    towards = np.where(gap[..., None] > 0, np.array(BRIGHTER, float), np.array(DARKER, float))
    return np.round((1 - amount) * np.array(SAME, float) + amount * towards).astype(np.uint8)


def vertex_colours(mesh: "trimesh.Trimesh") -> UInt8[np.ndarray, "n 3"]:
    """Return the sRGB colour of each vertex; PLAIN for a mesh without colours."""
    from trimesh.visual import ColorVisuals

    visual = mesh.visual
    if isinstance(visual, ColorVisuals) and visual.kind == "vertex":
        return np.ascontiguousarray(visual.vertex_colors[:, :3])
    return np.tile(np.array(PLAIN, np.uint8), (len(mesh.vertices), 1))


def mesh_picture(mesh: "trimesh.Trimesh", back: Float[np.ndarray, "3"], size: tuple[int, int]) -> Picture:
    """Draw a mesh in its vertex colours by orthographic projection, RGBA with a transparent background; it fits in.

    Args:
        back: world direction from the mesh to the viewer, not straight up.
        size: width and height, px.
    """
    width, height = size[0] * OVERSAMPLING, size[1] * OVERSAMPLING
    back = back / np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    axes = np.stack([right, -np.cross(back, right), -back])  # picture right, picture down, away
    seen = (mesh.vertices - mesh.bounds.mean(0)) @ axes.T
    scale = min(width / np.abs(seen[:, 0]).max(), height / np.abs(seen[:, 1]).max()) / (2 * MARGIN)
    away = FROM_AFAR * height
    places = (seen * scale * [1, -1, -1] - [0, 0, away]).astype(np.float32)  # OpenGL's: up, towards the viewer
    faces, light = np.asarray(mesh.faces, np.int32), _vertex_light(mesh, axes).astype(np.float32)
    picture, depth = np.zeros((height, width, 3), np.float32), np.full((height, width), 2 * away, np.float32)
    field = 2 * np.arctan(0.5 * height / away)
    how = cv2.TriangleRasterizeSettings().setShadingType(cv2.RASTERIZE_SHADING_SHADED)
    how = how.setCullingMode(cv2.RASTERIZE_CULLING_CW)
    cv2.triangleRasterize(places, faces, light, picture, depth, np.eye(4), field, 0.5 * away, 2 * away, how)
    drawn = np.dstack([picture, (depth < 2 * away).astype(np.float32)])
    blocks = cv2.resize(drawn, size, interpolation=cv2.INTER_AREA)  # means of whole blocks
    cover = blocks[..., 3:]
    linear = np.divide(blocks[..., :3], cover, out=np.zeros_like(blocks[..., :3]), where=cover > 0)
    return np.concatenate([encode_srgb(linear), np.round(255 * cover).astype(np.uint8)], -1)


def _vertex_light(mesh: "trimesh.Trimesh", axes: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "n 3"]:
    """Linear colour of each vertex under a light from the viewer's upper left, some from all around and from above."""
    normals = mesh.vertex_normals
    key = np.array([-0.45, -0.6, -0.66]) @ axes  # picture left, up and near
    lit = KEY * np.clip(normals @ key, 0, 1) + FILL + RIM * np.clip(normals[:, 2], 0, 1)
    return decode_srgb(vertex_colours(mesh)) * lit[:, None]
