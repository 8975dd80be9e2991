"""Recompute the labels with each better surface."""

from dataclasses import replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from reconstruct.appearance.brdf import Gloss
from reconstruct.appearance.lobe_fit import Indirect, from_endless_ground
from reconstruct.fields import SolvedScene
from reconstruct.labels.field_ground_test import label_ground
from reconstruct.labels.ground_test import empty_ground_test, test_ground
from reconstruct.labels.highlights import (
    lit_pixels,
    material_without_ground,
    matt_photos,
    surface_appearance,
    with_lit_ground,
    with_powers,
)
from reconstruct.labels.labels import Labels, assemble_labels
from reconstruct.labels.lit_labels import with_lit_normals
from reconstruct.labels.multiple_lights import check_lights, is_shared, split_on_surface
from reconstruct.labels.outline import Outline, outline_of, unsure_outline
from reconstruct.labels.photometric_stereo import ObjectLabels, ground_light, label_object
from reconstruct.labels.uneven_ground import cut_at_relief, ground_relief, ground_visibility
from reconstruct.render.interreflection import photo_interreflection, true_scale
from reconstruct.scene import Scene, ground_points, light_share
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.level_set import carried
from reconstruct.sdf.rays import first_hits


def _with_outline(labels: Labels, outline: Outline) -> Labels:
    return replace(labels, mask=outline.mask, mask_confidence=outline.confidence)


class Observer:
    """Compute the labels of one scene's pictures, given an estimate of the surface."""

    def __init__(self, scene: Scene):
        self._scene = scene
        self._ground = None
        if scene.rgb is not None:
            check_lights(scene)
            self._ground = label_ground(scene) if scene.ground_known else empty_ground_test(scene)
        self._relief = ground_relief(scene)
        self._carried: tuple[SdfGrid, SdfGrid] | None = None  # a surface, and the same in the scene's world

    def ground_labels(self) -> Labels:
        """Return the labels available before there is a surface: object or ground, and shadows on the ground."""
        labels = assemble_labels(self._scene, self._ground, None)
        if self._scene.mask is not None and not self._scene.mask_known:
            labels = _with_outline(labels, unsure_outline(self._scene.mask))
        return self._beside_relief(labels, None)

    def labels(self, surface: SdfGrid, scene: Scene) -> Labels:
        """Return the labels of ground and object; the object's are computed where pixel rays meet the surface.

        Args:
            scene: the observer's, with the ground that the surface stands on.
        """
        surface = self.in_world(surface)
        if self._ground is None:
            labels = assemble_labels(scene, None, None)
            if not scene.mask_known:
                labels = _with_outline(labels, outline_of(scene, surface, labels.confidence))
            return self._beside_relief(labels, surface)
        points, normals = self.seen(surface)
        if is_shared(scene):
            scene = split_on_surface(scene, surface, points, normals, self._ground)
            self._ground = test_ground(scene)
        on_object = self._on_object(surface, scene, points, normals)
        return self._beside_relief(assemble_labels(scene, self._ground, on_object), surface)

    def with_normals(self, labels: Labels, surface: SdfGrid, scene: Scene) -> Labels:
        """Return labels of a surface with normals: their own from photos, of shadow pictures see with_lit_normals."""
        if self._ground is not None:
            return labels
        return with_lit_normals(labels, scene, self.in_world(surface), *self.seen(surface))

    def _on_object(
        self,
        surface: SdfGrid,
        scene: Scene,
        points: Float[Tensor, "height width 3"],
        normals: Float[Tensor, "height width 3"],
    ) -> ObjectLabels:
        """Label the object's pixels from shading; without a ground, with highlights removed and powers fitted.

        A first look under an endless ground, or none, gives the albedo with which light between surfaces is found.
        """
        assert self._ground is not None
        on_object = label_object(scene, points, normals, self._ground.mask, self._ground, first_look=True)
        albedo = self._beside_ground(on_object.albedo, normals)
        indirect = self._between_surfaces(self._solved(surface, scene, albedo, None), scene)[1]
        if indirect is not None or on_object.is_alone:
            on_object = label_object(scene, points, normals, self._ground.mask, self._ground, indirect)
        material = None if scene.ground_known else material_without_ground(scene, points, on_object)
        if material is None:
            return on_object
        matt = matt_photos(scene, points, on_object, material)
        again = label_object(matt, points, normals, self._ground.mask, self._ground, indirect)
        lit = torch.maximum(on_object.visibility, again.visibility)  # an over-corrected highlight is no shadow
        return replace(again, visibility=lit)

    def _with_powers(
        self, scene: Scene, points: Float[Tensor, "height width 3"], normals: Float[Tensor, "height width 3"]
    ) -> Scene:
        """Return the scene with the power of each photo as the object shows it, where there is no ground."""
        assert self._ground is not None
        if scene.ground_known:
            return scene
        on_object = label_object(scene, points, normals, self._ground.mask, self._ground)
        material = material_without_ground(scene, points, on_object)
        return scene if material is None else with_powers(scene, material)

    def fields(self, surface: SdfGrid, scene: Scene) -> SolvedScene:
        """Return the solved scene: the surface, and the material estimated on it.

        All in the scene's world, and so is the surface of another object pose.
        """
        surface = self.in_world(surface)
        if self._ground is None:
            return self._solved(surface, scene, self.labels(surface, scene).albedo, None)
        points, normals = self.seen(surface)
        if is_shared(scene):
            scene = split_on_surface(scene, surface, points, normals, self._ground)
        scene = self._with_powers(scene, points, normals)
        read = partial(self._appearance, scene, points, normals, lit_pixels(scene, surface, points, normals))
        first = self._solved(surface, scene, *read(self._bounce(scene, points)))
        scale, indirect = self._between_surfaces(first, scene) if scene.ground_known else (0.0, None)
        if indirect is not None:
            albedo, gloss = read(indirect)
            first = replace(first, albedo=albedo, gloss=gloss, interreflection=scale)
        return replace(first, albedo=with_lit_ground(scene, self._ground, surface, points, normals, first.albedo))

    def _between_surfaces(self, solved: SolvedScene, scene: Scene) -> tuple[float, Indirect | None]:
        """Return the true scale of the albedo, and the light between surfaces; 0 and None where none shows."""
        interreflection = photo_interreflection(solved, scene) if self._relief is None else None
        scale = 0.0 if interreflection is None else true_scale(solved, scene, interreflection)
        if interreflection is None or scale == 0:
            return 0.0, None
        return scale, lambda at, facing: scale * interreflection.at(at, facing)

    def _solved(
        self, surface: SdfGrid, scene: Scene, albedo: Float[Tensor, "height width 3"], gloss: Gloss | None
    ) -> SolvedScene:
        surface = surface if self._relief is None else cut_at_relief(surface, self._relief)
        camera = (scene.camera, scene.world_from_camera)
        rest = (scene.ground_height, scene.unit, gloss)
        middle = surface.origin.double().numpy() + 0.5 * surface.spacing * (np.array(surface.values.shape) - 1)
        return SolvedScene(
            surface,
            albedo,
            *camera,
            *rest,
            view=scene.view,
            object_from_world=scene.object_from_world,
            light_share=light_share(scene, middle),
        )

    def _appearance(
        self,
        scene: Scene,
        points: Float[Tensor, "height width 3"],
        normals: Float[Tensor, "height width 3"],
        lit: Bool[Tensor, "photos n"],
        indirect: Indirect,
    ) -> tuple[Float[Tensor, "height width 3"], Gloss | None]:
        """Estimate the albedo of object and ground, and the object's gloss."""
        assert self._ground is not None
        albedo, gloss = surface_appearance(scene, points, normals, lit, indirect)
        return self._beside_ground(albedo, normals), gloss

    def _beside_ground(
        self, albedo: Float[Tensor, "height width 3"], normals: Float[Tensor, "height width 3"]
    ) -> Float[Tensor, "height width 3"]:
        """Return the albedo of the object where a surface is seen, and of the ground elsewhere."""
        assert self._ground is not None
        return torch.where((normals != 0).any(-1, keepdim=True), albedo, self._ground.albedo)

    def _beside_relief(self, labels: Labels, surface: SdfGrid | None) -> Labels:
        """Drop the labels in shadows that uneven ground casts on itself: they are not the object's."""
        if self._relief is None:
            return labels
        points = ground_points(self._scene) if surface is None else self.seen(surface)[0]
        return replace(labels, confidence=labels.confidence * ground_visibility(self._scene, self._relief, points))

    def in_world(self, surface: SdfGrid) -> SdfGrid:
        """Return a surface in the scene's world; one that this method has returned, as it is."""
        motion = self._scene.object_from_world
        if motion is None:
            return surface
        if self._carried is None or all(surface is not one for one in self._carried):
            self._carried = surface, carried(surface, motion.inverse())
        return self._carried[1]

    def _bounce(self, scene: Scene, points: Float[Tensor, "height width 3"]) -> Indirect:
        """Return the light that the lit ground reflects to the surface in each photo."""
        assert self._ground is not None
        where = (self._ground.mask > 0.5) & points.isfinite().all(-1)
        return from_endless_ground(ground_light(scene, points, where, self._ground))

    def seen(self, surface: SdfGrid) -> tuple[Float[Tensor, "height width 3"], Float[Tensor, "height width 3"]]:
        """Return where each pixel's ray meets the surface, else the ground behind, and its normal (0 on ground)."""
        scene, surface = self._scene, self.in_world(surface)
        shape = scene.directions.shape
        rays = scene.directions.reshape(-1, 3)
        points, normals = ground_points(scene).reshape(-1, 3), torch.zeros(rays.shape)
        to_ground = torch.nan_to_num((points - scene.eye).norm(dim=-1), nan=torch.inf)
        if not scene.ground_known:  # an assumed ground occludes nothing
            to_ground = torch.full_like(to_ground, torch.inf)
        first = first_hits(surface, scene.eye, rays, to_ground)
        hit = first.on_object
        points[hit] = scene.eye + first.distance[hit, None] * rays[hit]
        normals[hit] = normalize(surface.gradient(points[hit]), dim=-1)
        return points.reshape(shape), normals.reshape(shape)
