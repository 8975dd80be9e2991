"""Choose the start of a solve: the shadow hull, or a height field if there is no ground to carve with."""

from collections.abc import Callable
from dataclasses import replace
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from capture.errors import ReconstructionError, Remedy
from reconstruct.config import FitConfig, Level
from reconstruct.hull.bent_hull import JUDGES_BLOCK, JUDGES_SEED, JUDGES_SHARE, BentHull, Say
from reconstruct.hull.follow_normals import follow_normals
from reconstruct.hull.normal_integration import integrate_normals
from reconstruct.hull.shadow_hull import GroundMaps, carved
from reconstruct.initialization.height_field import HeightConfig, beside_nothing, fit_heights
from reconstruct.initialization.height_grid import base_of, height_grid
from reconstruct.initialization.height_view import height_view
from reconstruct.initialization.light_contradictions import contradictions
from reconstruct.initialization.shading_start import heights_from_shading
from reconstruct.labels.held_out import HeldOut, draw_blocks, hold_out, without
from reconstruct.labels.labels import Labels, not_isolated
from reconstruct.labels.multiple_lights import is_shared
from reconstruct.labels.observer import Observer
from reconstruct.labels.supervision import supervise
from reconstruct.scene import Scene
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.level_set import resampled
from reconstruct.views import Scenes, each

FEW_WRONG = 0.1  # wrong votes per node from given shadow pictures; above, one wrong vote must be tolerated
LIGHTS_PER_VOTE = 8  # a second vote costs completeness: it must be affordable
FEWEST_BARE = 0.02  # of the picture: less bare ground than this bounds no hull
FEWEST_LIGHTS = 4  # three for a pixel's albedo and normal, and one to detect a shadow
SURE = 0.5  # confidence from which a pixel is known to be bare
BOTH_AGREE = (48, 96, 192)  # px of the longer side in which normals and shadows are brought to agree, in turn
NODES_PER_PIXEL = 1.75  # along the picture: finer than a pixel, so that normals keep what a pixel can show
MOST_NODES = 320  # 300 MB with the accumulators of two cores, for a relief as deep as a third of its width
ITERATIONS = 12  # of the free surface: measured, the error of held-out rays rises again after some 30
RATE = (0.1, 0.05)  # voxels: the height field is right to about a voxel already
SHARPNESS = (8.0, 25.0)  # per voxel, for the same reason not from 4
HULL, LIT_HULL = "shadow hull", "shadow hull, bent to the lights that reach it"  # names of starts, in checkpoints
JUDGES_SHARPNESS = 25.0  # NeuS s per voxel, as at the end of the solve
CURVATURE = 0.1  # of the step size: the height field is smooth already

Show = Callable[[SdfGrid], None]  # takes a surface that is to be improved
Judge = Callable[[Scene, FitConfig], bool]  # whether a hull suits shadow pictures with a mask better than heights


@runtime_checkable
class Start(Protocol):
    """The start of a solve, and the surface it may return to."""

    name: str
    config: FitConfig  # the settings that suit this start

    def surface(self, show: Show = lambda _: None) -> SdfGrid:
        """Return the first surface.

        Args:
            show: is given what is there first: the hull before shading bends it, or a height field.
        """
        ...

    def standing(self, scenes: Scenes, start: SdfGrid) -> Scenes:
        """Return the scenes with the ground that the first surface stands on."""
        ...

    def labels(self, surface: SdfGrid, scenes: Scenes) -> tuple[Labels, ...]:
        """Return each view's labels for the solver, computed with the current surface."""
        ...

    def better(self, start: SdfGrid, found: SdfGrid, scenes: Scenes) -> SdfGrid:
        """Return the better of two surfaces."""
        ...

    def doubts(self) -> tuple[str, ...]:
        """Return warnings about lights that contradict each other."""
        ...


def choose_start(
    scenes: Scene | Scenes,
    observers: Observer | tuple[Observer, ...],
    config: FitConfig,
    say: Say = lambda _: None,
    judge: Judge = lambda *_: True,
    began_with: str = "",
) -> Start:
    """Choose the hull, or a height field if the ground is unknown, hardly seen, or `judge` prefers it.

    The hull is carved by shadows on known, bare ground. Shadow pictures alone may show a relief, which has one depth
    per pixel and hollows that no silhouette bounds, or an object with holes, which no height field holds: `judge` tells
    them apart. Several cameras always start with the hull that they carve together.

    Args:
        began_with: name of the start of the solve that is resumed: `judge` is not asked again.

    Raises:
        ReconstructionError: colour photos on an unknown ground, and too few or under several lights each.
    """
    scenes, observers = each(scenes), each(observers)
    hull = HullStart(scenes, observers, config, say, began_with or HULL)
    if len(scenes) > 1:
        return hull
    scene, observer = next(zip(scenes, observers, strict=True))
    if scene.rgb is not None and not scene.ground_known:
        _refuse_few(scene)
        return ShadingStart(scene, observer, config, say)
    if scene.shadow is None:
        return hull
    labels = observer.ground_labels()
    bare = (labels.mask < 0.5) & (labels.mask_confidence > SURE)
    share = float(bare.float().mean())
    if scene.ground_depth is not None and share >= FEWEST_BARE:
        return hull
    if scene.ground_depth is not None:
        raise ReconstructionError(
            f"{100 * share:.2g} % of the pixels show bare ground, {100 * FEWEST_BARE:g} % were needed: on uneven "
            "ground no height field can start. Give a mask, or photos that show more ground."
        )
    if scene.ground_known and share >= FEWEST_BARE and _suits_hull(scene, config, judge, began_with):
        return hull
    return HeightStart(scene, observer, config, say)


def _suits_hull(scene: Scene, config: FitConfig, judge: Judge, began_with: str) -> bool:
    """Return whether a scene on bare ground starts with the hull: with colours, or as `judge` says of shadow pictures.

    Args:
        began_with: as of choose_start.
    """
    if scene.rgb is not None:
        return True
    if began_with:
        return began_with in (HULL, LIT_HULL)
    return judge(scene, config)


class HullStart:
    """Start from the shadow hull, which coarse levels then correct."""

    def __init__(self, scenes: Scenes, observers: tuple[Observer, ...], config: FitConfig, say: Say, name: str = HULL):
        self._scenes, self._observers, self.config, self._say = scenes, observers, config, say
        self._doubts: tuple[str, ...] | None = None  # where no better surface changes the ground's labels
        self.name = name  # LIT_HULL if the normals of shadow pictures made it better: surface() decides

    def surface(self, show: Show = lambda _: None) -> SdfGrid:
        """Return the hull on the first level's grid, bent to the normals of shading; it is shown as it was carved."""
        nodes = self.config.levels[0].nodes
        votes = self.config.votes or _votes(self._scenes)
        ground_labels = tuple(observer.ground_labels() for observer in self._observers)
        found = carved(self._scenes, ground_labels, votes, nodes)
        hull = resampled(found.grid, nodes).grid()
        show(hull)
        views = list(zip(self._scenes, self._observers, strict=True))
        if len(views) > 1:
            return hull
        scene, observer = views[0]
        if scene.ground_depth is None and not is_shared(scene):
            self._doubts = _doubts(scene, ground_labels[0], found.maps)  # these maps are made once
        bent = BentHull(scene, observer, self.config, self._say).found(hull)
        if scene.rgb is None and bent is not hull:
            self.name = LIT_HULL
        return bent

    def standing(self, scenes: Scenes, start: SdfGrid) -> Scenes:
        """Return the scenes themselves: their ground is known."""
        return scenes

    def labels(self, surface: SdfGrid, scenes: Scenes) -> tuple[Labels, ...]:
        """Return all labels, with normals of shadow pictures where these made the hull better."""
        found = tuple(observer.labels(surface, s) for observer, s in zip(self._observers, scenes, strict=True))
        return (self._observers[0].with_normals(found[0], surface, scenes[0]),) if self.name == LIT_HULL else found

    def better(self, start: SdfGrid, found: SdfGrid, scenes: Scenes) -> SdfGrid:
        """Return the found surface: the hull is never better."""
        return found

    def doubts(self) -> tuple[str, ...]:
        """Return the contradictions between the shadows on the ground in a view; uneven ground is not judged."""
        if self._scenes[0].ground_depth is not None:
            return ()
        if self._doubts is not None:
            return self._doubts
        views = zip(self._scenes, self._observers, strict=True)
        return tuple(said for scene, observer in views for said in _doubts(scene, observer.ground_labels()))


def _doubts(scene: Scene, labels: Labels, maps: GroundMaps | None = None) -> tuple[str, ...]:
    """Return the contradictions between the shadows on the ground in one view, see `contradictions`."""
    of = f"{scene.view}: " if scene.view else ""
    return tuple(of + doubt for doubt in contradictions(scene, labels, maps).sentences())


def _votes(scenes: Scenes) -> int:
    """Return how many votes carve a node: 1 for given shadow pictures (2 if noisy), 2 for labels from photos.

    One more if the lights are estimates; fewer with few lights. Isolated wrong pixels of a shadow picture can be
    detected; their number estimates that of the other wrong pixels, which lie beside edges.
    """
    is_clean = all(s.rgb is None and s.shadow is not None and _wrong_votes(s.shadow) <= FEW_WRONG for s in scenes)
    wanted = 2 - is_clean + any(bool(scene.light_sigma.any()) for scene in scenes)
    return min(wanted, max(1, sum(len(scene.lights) for scene in scenes) // LIGHTS_PER_VOTE))


def _wrong_votes(shadow: Float[Tensor, "photos height width"]) -> float:
    """Return the mean number of isolated pixels that vote on a node of the hull."""
    return float(1 - not_isolated(shadow).mean()) * len(shadow)


class HeightStart:
    """Start from a height field, followed by one short, fine level of the free surface.

    The free surface is kept if it explains held-out rays better.
    """

    name = "height field"

    def __init__(self, scene: Scene, observer: Observer, config: FitConfig, say: Say):
        self._scene, self._observer, self._say = scene, observer, say
        self._judge: tuple[SdfGrid, float, HeldOut] | None = None  # a surface, the ground's height, and its rays
        self._nodes = min(MOST_NODES, round(NODES_PER_PIXEL * max(scene.camera.width, scene.camera.height)))
        level = Level(self._nodes, ITERATIONS, RATE, config.levels[-1].blur)
        self.config = replace(config, levels=(level,), sharpness=SHARPNESS, curvature=CURVATURE)

    def surface(self, show: Show = lambda _: None) -> SdfGrid:
        """Return the solid under the height field."""
        labels = without(self._with_isolated_pixels(self._observer.ground_labels()), self._drawn())
        field = fit_heights(height_view(self._scene, labels), HeightConfig())
        surface = height_grid(field, self._scene, self._nodes)
        show(surface)
        return surface

    def standing(self, scenes: Scenes, start: SdfGrid) -> Scenes:
        """Return the scene with the height field's base as ground, if the ground is unknown."""
        (scene,) = scenes
        return (scene if scene.ground_known else replace(scene, ground_height=base_of(start)),)

    def labels(self, surface: SdfGrid, scenes: Scenes) -> tuple[Labels, ...]:
        """Return the labels without those of the held-out rays, which `better` is to ask if this is its start."""
        (scene,) = scenes
        labels = self._with_isolated_pixels(self._observer.labels(surface, scene))
        if self._judge is None:
            self._judge = (surface, scene.ground_height, self._held_out(scene, labels))
        return (without(labels, self._drawn()),)

    def better(self, start: SdfGrid, found: SdfGrid, scenes: Scenes) -> SdfGrid:
        """Return the free surface, unless the height field explains the held-out rays better."""
        (scene,) = scenes
        held_out, self._judge = self._judge_of(start, scene), None
        return min((start, found), key=lambda grid: held_out.error(grid, scene, JUDGES_SHARPNESS))

    def _judge_of(self, start: SdfGrid, scene: Scene) -> HeldOut:
        """Return the rays held out, by the labels of a surface: those read last time are not read again."""
        if self._judge is not None:
            read, height, held_out = self._judge
            if read is start and height == scene.ground_height:
                return held_out
        return self._held_out(scene, self._with_isolated_pixels(self._observer.labels(start, scene)))

    def _held_out(self, scene: Scene, labels: Labels) -> HeldOut:
        rays = supervise(scene, labels)
        return hold_out(rays, self._drawn()[:, rays.pixels], with_outline=True)[1]

    def doubts(self) -> tuple[str, ...]:
        """Return nothing: without bare ground no light's shadow can be judged by itself."""
        return ()

    def _drawn(self) -> Bool[np.ndarray, "photos pixels"]:
        """Draw the rays held out from both surfaces: True where one is held out."""
        camera, seed = self._scene.camera, (self.config.seed, JUDGES_SEED)
        picture = np.arange(camera.width * camera.height), camera.width, len(self._scene.lights)
        return draw_blocks(*picture, seed, JUDGES_BLOCK, JUDGES_SHARE)

    def _with_isolated_pixels(self, labels: Labels) -> Labels:
        """Restore isolated pixels of clean shadow pictures: they carve nothing here, and are tips of shadows."""
        shadow = self._scene.shadow
        if shadow is None or self._scene.rgb is not None or _wrong_votes(shadow) > FEW_WRONG:
            return labels
        return replace(labels, confidence=torch.where(not_isolated(shadow) > 0, labels.confidence, 1.0))


class ShadingStart(HeightStart):
    """Start from colour photos: a height field that agrees with the normals of photometric stereo and the shadows."""

    name = "height field from shading and shadows"

    def surface(self, show: Show = lambda _: None) -> SdfGrid:
        """Return the solid under the height field; beside the object there is nothing.

        Normals do not show depth discontinuities, and integration across them is wrong everywhere; shadows alone show
        no detail. Both are recomputed on each better surface, which may be coarse: the final detail comes from the
        integral of the normals on it.
        """
        labels = self._observer.ground_labels()
        self._say("integrating the normals of shading to a height field")
        shaded = heights_from_shading(self._scene, labels.mask, height_view(self._scene, labels))
        start = surface = height_grid(shaded, self._scene, self._nodes)
        show(start)
        for longest in BOTH_AGREE:
            self._say(f"bringing shading and shadows to agree on {longest} px")
            (labels,) = self.labels(surface, (self._scene,))
            field = beside_nothing(fit_heights(height_view(self._scene, labels), HeightConfig(longest=longest)))
            surface = height_grid(field, self._scene, self._nodes)
        self._say("following the normals at full size")
        (labels,) = self.labels(surface, (self._scene,))
        surface = follow_normals(surface, self._scene, *self._observer.seen(surface), labels, integrate_normals)
        return self.better(start, resampled(surface, self._nodes).grid(), (self._scene,))


def _refuse_few(scene: Scene) -> None:
    """Refuse colour photos that do not determine the shape by themselves."""
    if len(scene.lights) < FEWEST_LIGHTS or is_shared(scene):
        found = "photos under several lights at once" if is_shared(scene) else f"{len(scene.lights)} photos"
        raise ReconstructionError(
            f"{found} on an unknown ground; {FEWEST_LIGHTS} or more under one light each were needed, to read shape "
            "from shading alone.",
            "take more photos",
            Remedy.GROUND,
        )
