"""Truth: spheres and slabs of known volume; and files read back byte by byte."""

import json
import struct
from dataclasses import replace
from pathlib import Path

import fake_run
import numpy as np
import pytest
import torch
import trimesh
from scipy.ndimage import gaussian_filter

from calibration.camera import Camera
from calibration.pose import Pose
from capture.errors import ReconstructionError
from capture.photos.photo import decode_srgb
from reconstruct.fields import SolvedScene
from reconstruct.mesh.mesh import extract_mesh, preview_mesh, save_mesh, surface_mesh, vertex_colours
from reconstruct.mesh.simplify import bounds_a_solid, simplified
from reconstruct.mesh.texture import PhotoColours, TexturedMesh, bake, vertex_tangents
from reconstruct.sdf.grid import SdfGrid
from reconstruct.stored_run.ply import read_preview

RADIUS = 10.0
RED = (0.5, 0.05, 0.01)


def sphere_grid(height: float, spacing: float = 1.0, extra: int = 3) -> SdfGrid:
    half = RADIUS + extra * spacing
    axis = torch.arange(-half, half + 0.5 * spacing, spacing)
    nodes = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    return SdfGrid(nodes.norm(dim=-1) - RADIUS, torch.tensor([-half, -half, height - half]), spacing)


def solved(grid: SdfGrid, unit: str = "mm") -> SolvedScene:
    """Seen from straight above, all red."""
    camera = Camera(60, 60, 120.0, 120.0, 29.5, 29.5)
    pose = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 80.0]))
    return SolvedScene(grid, torch.tensor(RED).expand(60, 60, 3).contiguous(), camera, pose, 0.0, unit)


def glb_parts(path: Path) -> tuple[dict, bytes]:
    data = path.read_bytes()
    magic, version, length, size = struct.unpack("<4sIII", data[:16])
    assert (magic, version, length) == (b"glTF", 2, len(data))
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def accessor(document: dict, binary: bytes, index: int, kind: str, columns: int) -> np.ndarray:
    view = document["bufferViews"][document["accessors"][index]["bufferView"]]
    part = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    return np.frombuffer(part, kind).reshape(-1, columns)


def test_a_sphere_becomes_a_closed_outward_mesh_of_its_volume_and_area():
    mesh = extract_mesh(solved(sphere_grid(height=20)))
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.01)  # chords lose h^2 / 4 r^2 a few times
    assert mesh.area == pytest.approx(4 * np.pi * RADIUS**2, rel=0.01)
    outward = (mesh.vertices - [0, 0, 20]) / RADIUS
    assert ((mesh.vertex_normals * outward).sum(1) > 0.995).all()
    assert (mesh.area_faces > 0).all()


def test_the_ground_cuts_the_object_flat_and_closes_it():
    mesh = extract_mesh(solved(sphere_grid(height=0.3)))
    cap = np.pi * (RADIUS + 0.3) ** 2 * (3 * RADIUS - RADIUS - 0.3) / 3
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(cap, rel=0.01)
    assert mesh.vertices[:, 2].min() == pytest.approx(0, abs=1e-6)
    base = mesh.face_normals[:, 2] < -0.999
    assert mesh.area_faces[base].sum() == pytest.approx(np.pi * (RADIUS**2 - 0.3**2), rel=0.01)
    assert (mesh.vertex_normals[mesh.vertices[:, 2] < 1e-6][:, 2] < 0).all()


def test_a_cut_between_nodes_is_where_the_ball_crosses_the_ground_and_its_inside_faces_down():
    height = 8.3  # nodes lie 0.3 of a voxel above the ground; the ball widens by 1.5 voxels per voxel there
    mesh = extract_mesh(solved(sphere_grid(height)))
    on_ground = mesh.vertices[:, 2] < 1e-6
    away = np.linalg.norm(mesh.vertices[on_ground, :2], axis=1)
    assert away.max() == pytest.approx(np.sqrt(RADIUS**2 - height**2), abs=0.1)
    inner = mesh.vertex_normals[on_ground][away < 3]
    np.testing.assert_allclose(inner, np.tile([0.0, 0.0, -1.0], (len(inner), 1)), atol=1e-6)


def test_an_object_that_leaves_the_box_is_closed_at_its_walls():
    grid = sphere_grid(height=20)
    cut = SdfGrid(grid.values[8:], grid.origin + torch.tensor([8.0, 0, 0]), 1.0)
    mesh = extract_mesh(solved(cut))
    assert mesh.is_watertight
    assert mesh.bounds[0, 0] == pytest.approx(-5, abs=1)


def test_debris_is_dropped_a_second_object_is_kept_and_a_cavity_inside_is_filled():
    values = torch.full((60, 30, 30), 5.0)
    values[5:25, 5:25, 5:25] = -1
    values[40:50, 5:15, 5:15] = -1
    values[55:57, 20:22, 20:22] = -1  # 8 of 8000 nodes
    values[12:16, 12:16, 12:16] = 1
    mesh = surface_mesh(SdfGrid(values, torch.zeros(3), 1.0), -1.0, 10**6)
    assert mesh.body_count == 2 and mesh.is_watertight


def test_a_small_piece_that_the_camera_sees_stays_and_a_crumb_does_not():
    values = torch.full((40, 40, 40), 5.0)
    values[6:34, 6:34, 1:20] = -1
    values[2:5, 12:28, 30:33] = -1  # 1 % of the volume of the first, beside it as seen from above
    values[36, 36, 30] = -1
    grid = SdfGrid(values, torch.tensor([-10.0, -10, 0]), 0.5)
    assert surface_mesh(grid, 0.0, 10**6).body_count == 1
    mesh = extract_mesh(solved(grid))
    assert mesh.body_count == 2 and mesh.is_watertight
    assert mesh.bounds[0, 0] < -8


@pytest.mark.parametrize("blur", [0.0, 1.5])
def test_even_noise_has_a_closed_surface(blur):
    noise = gaussian_filter(np.random.default_rng(3).normal(size=(30, 30, 30)), blur).astype(np.float32)
    assert surface_mesh(SdfGrid(torch.from_numpy(noise), torch.zeros(3), 1.0), 9.7, 10**6).is_watertight


def test_empty_space_too_fine_a_grid_and_an_empty_mesh_are_refused_and_leave_no_file(tmp_path):
    with pytest.raises(ReconstructionError, match=r"no surface was found above the ground.*report"):
        extract_mesh(solved(SdfGrid(torch.ones(5, 5, 5), torch.zeros(3), 1.0)))
    with pytest.raises(ReconstructionError, match=r"0.00926 million nodes.*at most 0.001 million"):
        extract_mesh(solved(sphere_grid(height=20)), max_nodes=1000)
    empty = trimesh.Trimesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    with pytest.raises(ReconstructionError, match="no triangles"):
        save_mesh(empty, tmp_path / "mesh.ply", tmp_path / "mesh.glb", "mm")
    assert not list(tmp_path.iterdir())


def test_a_preview_is_coarser_and_closed():
    grid = sphere_grid(height=20, spacing=0.5)
    preview = preview_mesh(grid, 0.0, max_nodes=20**3)
    assert preview is not None and preview.is_watertight
    assert len(preview.faces) < 0.2 * len(extract_mesh(solved(grid)).faces)
    assert preview.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.1)


def test_a_preview_has_the_colours_of_the_photos_and_behind_those_of_the_nearest_that_are_seen():
    preview, fields = preview_mesh(sphere_grid(height=20), 0.0), solved(sphere_grid(height=20))
    photos = torch.zeros(4, 60, 60, 3)
    photos[:2, :, :30, 0] = photos[:2, :, 30:, 2] = 0.5  # red on the left, blue on the right; two photos are dark
    assert preview is not None
    found = vertex_colours(PhotoColours(fields.posed_camera, photos).coloured(preview)).astype(int)
    x, aside = preview.vertices[:, 0], np.abs(preview.vertices[:, 0]) > 1
    assert aside.sum() > 0.8 * len(x) and preview.is_watertight
    assert ((found[:, 2] - found[:, 0] > 200) == (x > 0))[aside].all()
    assert ((found[:, 0] - found[:, 2] > 200) == (x < 0))[aside].all()


def test_a_sheet_between_the_nodes_of_a_preview_has_none():
    place = torch.arange(40.0)
    sheet = ((place - 21).abs() - 0.8)[:, None, None].expand(40, 40, 40).contiguous()
    grid = SdfGrid(torch.maximum(sheet, ((place - 20).abs() - 15)[None, :, None]), torch.zeros(3), 1.0)
    assert len(extract_mesh(solved(grid)).faces) > 1000
    assert preview_mesh(grid, 0.0, max_nodes=20**3) is None


def test_the_ply_holds_srgb_colours_in_the_world_frame_and_the_glb_linear_ones_in_metres_y_up_and_no_metal(tmp_path):
    mesh = extract_mesh(solved(sphere_grid(height=20)))
    save_mesh(mesh, tmp_path / "mesh.ply", tmp_path / "mesh.glb", "mm")
    read = trimesh.load(tmp_path / "mesh.ply", process=False)
    assert np.allclose(read.bounds, mesh.bounds, atol=1e-4)
    assert read.visual.vertex_colors[0, :3].tolist() == [188, 63, 25]  # IEC 61966-2-1 of 0.5, 0.05, 0.01
    assert "nx" in (tmp_path / "mesh.ply").read_bytes()[:600].decode("ascii", "ignore")
    document, binary = glb_parts(tmp_path / "mesh.glb")
    named = document["meshes"][0]["primitives"][0]["attributes"]
    vertices = accessor(document, binary, named["POSITION"], "<f4", 3)
    assert np.allclose(vertices.mean(0), [0, 0.02, 0], atol=1e-4)
    assert np.allclose(
        vertices, np.c_[mesh.vertices[:, 0], mesh.vertices[:, 2], -mesh.vertices[:, 1]] / 1000, atol=1e-6
    )
    colours = accessor(document, binary, named["COLOR_0"], "<u2", 4) / 65535
    assert document["accessors"][named["COLOR_0"]]["normalized"]
    assert np.allclose(colours[0], [*RED, 1], atol=0.004)  # through 8-bit sRGB
    material = document["materials"][document["meshes"][0]["primitives"][0]["material"]]["pbrMetallicRoughness"]
    assert (material["metallicFactor"], material["roughnessFactor"]) == (0, 1)
    again = trimesh.load_mesh(tmp_path / "mesh.glb")
    assert len(again.faces) == len(mesh.faces) and again.volume > 0


# --- reading what a stranger's preview says --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        (b"element vertex 162", b"element vertex 9999999999999999999"),
        (b"element vertex 162", b"element vertex 12"),  # faces then point past the last vertex
        (b"property float x", b"property list x"),
        (b"binary_little_endian", b"ascii"),
        (b"element face 320", b"element face 0"),
    ],
)
def test_a_header_that_is_not_ours_is_no_mesh(tmp_path, ours, theirs):
    content = trimesh.creation.icosphere(subdivisions=2, radius=30.0).export(file_type="ply")
    assert ours in content
    (tmp_path / "preview.ply").write_bytes(content.replace(ours, theirs, 1))
    assert read_preview(tmp_path / "preview.ply") is None


# --- fewer triangles -------------------------------------------------------------------------------------------------


def sphere(subdivisions: int = 4) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions, 10.0)
    colours = np.where(mesh.vertices[:, :1] > 0, [[200, 20, 20, 255]], [[20, 20, 200, 255]]).astype(np.uint8)
    mesh.visual.vertex_colors = colours
    return mesh


def thin_star() -> trimesh.Trimesh:
    """Blades a tenth as thick as a triangle is wide: reduced, they fold and pinch."""
    blades = [trimesh.creation.box((20, 0.3, 20)) for _ in range(5)]
    for k, blade in enumerate(blades):
        for _ in range(4):
            blade = blade.subdivide()
        blade.apply_translation([0, k * 3.0, 0])
        blade.vertices += np.random.default_rng(k).normal(0, 0.04, blade.vertices.shape)
        blades[k] = blade
    return trimesh.util.concatenate(blades)


@pytest.mark.parametrize("faces", [200, 1000, 3000])
def test_a_sphere_keeps_its_volume_and_stays_closed(faces):
    small = simplified(sphere(), faces)
    assert len(small.faces) <= faces
    assert small.is_watertight and small.is_winding_consistent
    assert small.volume == pytest.approx(4 / 3 * np.pi * 1000, rel=8.0 / faces + 0.003)


def test_colours_and_normals_are_those_of_the_full_mesh():
    small = simplified(sphere(), 400)
    red = small.visual.vertex_colors[:, 0] > 100
    assert (small.vertices[red, 0] > -1).all() and (small.vertices[~red, 0] < 1).all()
    assert ((small.vertex_normals * small.vertices / 10).sum(1) > 0.97).all()


@pytest.mark.parametrize("faces", [120, 400, 1500])
def test_thin_parts_that_collapse_leave_no_holes(faces):
    full = thin_star()
    small = simplified(full, faces)
    assert small.is_watertight
    assert len(small.faces) < 0.9 * len(full.faces)


def test_a_surface_with_a_hole_bounds_no_solid_and_two_boxes_that_touch_along_an_edge_do():
    full = sphere(2)
    assert bounds_a_solid(full.vertices, full.faces)
    assert not bounds_a_solid(full.vertices, full.faces[1:])
    assert not bounds_a_solid(full.vertices, full.faces[:, ::-1])  # inside out
    one, other = trimesh.creation.box((1, 1, 1)), trimesh.creation.box((1, 1, 1))
    other.apply_translation([1, 1, 0])
    both = trimesh.util.concatenate([one, other])
    both.merge_vertices()
    assert not both.is_watertight
    assert bounds_a_solid(both.vertices, both.faces)


# --- pictures on a mesh ----------------------------------------------------------------------------------------------


SIZE = 256


@pytest.fixture(scope="module")
def fields(truth):
    return fake_run.fields_of(truth)


@pytest.fixture(scope="module")
def full(fields):
    return extract_mesh(fields)


@pytest.fixture(scope="module")
def baked(fields, full) -> TexturedMesh:
    return bake(fields, simplified(full, 3000), full, SIZE)


def sampled(baked: TexturedMesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """World places, shaded normals and linear base colours at the triangles' middles, as glTF says they are read."""
    uv = baked.uv[baked.faces].mean(1)
    column, row = np.clip((uv * SIZE).astype(int), 0, SIZE - 1).T
    local = baked.normal_map[row, column] / 127.5 - 1
    normal = baked.normals[baked.faces].mean(1)
    tangent = baked.tangents[baked.faces].mean(1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    along = tangent[:, :3] / np.linalg.norm(tangent[:, :3], axis=1, keepdims=True)
    up = np.cross(normal, along) * tangent[:, 3:]
    shaded = local[:, :1] * along + local[:, 1:2] * up + local[:, 2:] * normal
    places = baked.vertices[baked.faces].mean(1)
    return places, shaded / np.linalg.norm(shaded, axis=1, keepdims=True), decode_srgb(baked.base[row, column])


def test_shaded_normals_are_those_of_the_full_surface(fields, baked):
    places, shaded, _ = sampled(baked)
    wanted = torch.nn.functional.normalize(fields.grid.gradient(torch.from_numpy(places).float()), dim=-1).numpy()
    smooth = np.linalg.norm(places - [-25, 10, 35], axis=1) < 36  # the large ball, away from the others' edges
    smooth &= (places[:, 0] < -10) & (places[:, 2] > 8)
    assert smooth.sum() > 300
    angle = np.degrees(np.arccos(np.clip((shaded * wanted).sum(1)[smooth], -1, 1)))
    assert np.median(angle) < 1.5 and np.percentile(angle, 95) < 6


def test_colours_are_those_of_the_photo_and_the_base_is_flat_and_looks_down(fields, baked):
    places, shaded, base = sampled(baked)
    seen = (places[:, 1] < -5) & (places[:, 2] > 20)  # towards the camera
    ball = seen & (places[:, 0] < 0)
    assert np.median(base[ball], axis=0) == pytest.approx([0.7, 0.6, 0.5], abs=0.06)  # a pattern of 15 % lies on it
    base = places[:, 2] < 0.1
    assert base.any()
    assert (shaded[base, 2] < -0.99).all()


def test_tangents_follow_the_picture():
    """A square in the xz plane seen from -y, its picture upright: u along +x, up along +z."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]])
    uv = np.array([[0.0, 1], [1, 1], [1, 0], [0, 0]])  # v down
    normals = np.tile([0.0, -1, 0], (4, 1))
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    tangents = vertex_tangents(vertices, normals, uv, faces)
    assert np.allclose(tangents, [1, 0, 0, 1])
    assert np.allclose(np.cross(normals, tangents[:, :3]) * tangents[:, 3:], [0, 0, 1])
    mirrored = vertex_tangents(vertices, normals, uv * [-1, 1] + [1, 0], faces)
    assert np.allclose(mirrored, [-1, 0, 0, -1])


def test_a_scene_that_no_photo_saw_is_baked_too(fields, full):
    dark = replace(fields, albedo=torch.zeros_like(fields.albedo))
    assert not bake(dark, simplified(full, 500), full, 64).base.any()
