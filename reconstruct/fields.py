"""A solved scene, and its file."""

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from calibration.camera import Camera
from calibration.pose import Pose
from calibration.posed_camera import PosedCamera
from capture.errors import ReconstructionError
from capture.files.atomic import atomic_file
from reconstruct.appearance.brdf import Gloss
from reconstruct.sdf.grid import SdfGrid

SIGMAS = 1.64  # of its noise by which the held-out error must fall: chance alone does that once in twenty times


FORMAT = "1"


@dataclass(frozen=True)
class Verdict:
    """Mean |T - label| of held-out shadow rays, with the surface settled under either set of lights."""

    calibrated: float
    refined: float
    noise: float  # one sigma of the difference, from how it varies between photos

    @property
    def is_accepted(self) -> bool:
        """Whether the refined lights explain held-out shadows better, by more than noise."""
        return self.calibrated - self.refined > SIGMAS * self.noise

    def sentence(self) -> str:
        """State the decision and its numbers."""
        numbers = (
            f"shadow rays that were held out are off by {100 * self.refined:.3g} % with them and by "
            f"{100 * self.calibrated:.3g} % with the calibrated ones, noise {100 * self.noise:.2g} %"
        )
        return f"refined lights {'accepted' if self.is_accepted else 'rejected'}: {numbers}"


@dataclass(frozen=True)
class Fields:
    """A solved scene: all that a mesh or a relit picture needs. World frame."""

    grid: SdfGrid
    albedo: Float[Tensor, "height width 3"]  # linear, object and ground, on the pixel grid of `camera`
    camera: Camera  # of the working grid
    world_from_camera: Pose
    ground_height: float
    unit: str  # "mm" | "scene"
    lights: Float[Tensor, "photos 4"] | None = None  # homogeneous, where the solve left them; as Scene.photo_names
    gloss: Gloss | None = None  # on the same pixels as albedo; None: matt
    evidence: Float[Tensor, "nx ny nz"] | None = None  # rays whose edge passes each node, see evidence.ray_counts
    light_trial: Verdict | None = None  # on lights that moved; None: none did
    doubts: tuple[str, ...] = ()  # warnings for the user about photos and lights that contradict each other
    interreflection: float = 0.0  # true albedo over `albedo`, by the light that surfaces send each other; 0: none seen

    @property
    def posed_camera(self) -> PosedCamera:
        """The camera of the working grid above its ground."""
        return PosedCamera(self.camera, self.world_from_camera, self.ground_height)

    def scaled(self, factor: float, unit: str) -> "Fields":
        """Return the same scene in another unit, of which `factor` are one of this one's."""
        grid = SdfGrid(factor * self.grid.values, factor * self.grid.origin, factor * self.grid.spacing)
        pose = Pose(self.world_from_camera.rotation, factor * self.world_from_camera.translation)
        lights = self.lights
        if lights is not None:
            is_point = lights[:, 3:] > 0
            lights = torch.cat([torch.where(is_point, factor * lights[:, :3], lights[:, :3]), lights[:, 3:]], 1)
        height = factor * self.ground_height
        return replace(self, grid=grid, world_from_camera=pose, lights=lights, ground_height=height, unit=unit)

    def __repr__(self) -> str:
        nodes = " x ".join(map(str, self.grid.values.shape))
        surface = "matt" if self.gloss is None else "glossy"
        return f"Fields({nodes} nodes of {self.grid.spacing:.3g} {self.unit}, {surface})"


def as_stored(fields: Fields) -> Fields:
    """Round the fields to the precision of their file, so that a solved scene equals its file."""
    gloss = fields.gloss
    return replace(
        fields,
        albedo=fields.albedo.half().float(),
        gloss=None if gloss is None else replace(gloss, weights=gloss.weights.half().float()),
        evidence=None if fields.evidence is None else fields.evidence.half().float(),
    )


def save_fields(fields: Fields, path: Path) -> None:
    """Write Fields as safetensors, with the rest as JSON in the header; whole or not at all."""
    tensors = {
        "sdf": fields.grid.values.contiguous(),
        "origin": fields.grid.origin.contiguous(),
        "albedo": fields.albedo.half().contiguous(),
        "world_from_camera": torch.from_numpy(fields.world_from_camera.matrix()),
    }
    if fields.lights is not None:
        tensors["lights"] = fields.lights.contiguous()
    if fields.evidence is not None:
        tensors["evidence"] = fields.evidence.half().contiguous()
    if fields.gloss is not None:
        tensors |= {"lobes": fields.gloss.lobes.contiguous(), "lobe_weights": fields.gloss.weights.half().contiguous()}
    rest = {
        "spacing": fields.grid.spacing,
        "camera": asdict(fields.camera),
        "ground_height": fields.ground_height,
        "unit": fields.unit,
        "light_trial": None if fields.light_trial is None else asdict(fields.light_trial),
        "doubts": fields.doubts,
        "interreflection": fields.interreflection,
    }
    with atomic_file(path) as temporary:
        save_file(tensors, temporary, {"format": FORMAT, "fields": json.dumps(rest)})


def load_fields(path: Path) -> Fields:
    """Read Fields from a file written by save_fields.

    Raises:
        ReconstructionError: the file is missing, damaged, or of another format.
    """
    try:
        with safe_open(path, "pt") as file:
            header = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
        if header.get("format") != FORMAT:
            raise ReconstructionError(f"{path}: format {header.get('format')!r} found, {FORMAT!r} needed; run again.")
        rest = json.loads(header["fields"])
        camera = rest["camera"] | {"distortion": tuple(rest["camera"]["distortion"])}
        return Fields(
            SdfGrid(tensors["sdf"], tensors["origin"], float(rest["spacing"])),
            tensors["albedo"].float(),
            Camera(**camera),
            Pose.from_matrix(tensors["world_from_camera"].numpy()),
            float(rest["ground_height"]),
            str(rest["unit"]),
            tensors.get("lights"),
            Gloss(tensors["lobes"], tensors["lobe_weights"].float()) if "lobes" in tensors else None,
            tensors["evidence"].float() if "evidence" in tensors else None,
            Verdict(**rest["light_trial"]) if rest.get("light_trial") else None,
            tuple(str(text) for text in rest.get("doubts", [])),
            float(rest.get("interreflection", 0.0)),
        )
    except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
        raise ReconstructionError(f"{path}: not a readable result ({error}); run the reconstruction again.") from error
