"""What the tab "Material" does to the picture and the mesh of a finished run."""

import fake_run
import numpy as np
import pytest
from panel_context import click, make_context, make_tab, result_of, view_of
from waiting import wait_until

from calibration.light import Light
from capture.photos.photo import decode_srgb
from reconstruct.appearance.brdf import MATERIALS
from reconstruct.render.material_edit import BoxRegion, BrushRegion, ObjectRegion
from viewer.display.pictures import vertex_colours
from viewer.panels.material import OWN, CachedEdits, MaterialPanel, own_material

FRONT = np.array([-25.0, -25.0, 35.0])  # of the large ball, towards the camera
EYE = np.array([-25.0, -300.0, 35.0])
UP = np.array([0.0, 0.0, 1.0])
LAMP = Light("", "point", position=np.array([100.0, -100.0, 300.0]))


@pytest.fixture(scope="module")
def result():
    return result_of(fake_run.make_truth(width=64, n_lights=6))


@pytest.fixture
def editing(server, result):
    context, shown = make_context(server)
    panel = MaterialPanel(context, make_tab(context))
    panel.show(result)
    yield panel, context, shown
    panel.close()


def press(button) -> None:
    """As a visitor's click."""
    for callback in button._impl.update_cb:
        callback(None)


def colour_at(mesh, place: np.ndarray) -> np.ndarray:
    return vertex_colours(mesh)[np.linalg.norm(mesh.vertices - place, axis=1).argmin()]


def test_at_first_nothing_is_changed(editing):
    panel, _, shown = editing
    assert panel.edits() == [] and shown.content.edit is None and shown.mesh is None and shown.content.map is None


def test_gold_on_the_whole_object_is_in_the_picture_and_on_the_mesh_and_undo_takes_it_away(editing, result):
    panel, _, shown = editing
    press(panel._apply)
    view = view_of(result)
    edited = shown.content.edit(view)
    assert edited.gloss is not None and (edited.albedo[view.maps.mask] == 0).all()
    assert (edited.albedo[~view.maps.mask] == view.albedo[~view.maps.mask]).all()
    np.testing.assert_allclose(decode_srgb(colour_at(shown.mesh, FRONT)), MATERIALS["gold"].mirrored, atol=0.01)
    assert "Gold: whole object" in panel._list.content and panel._undo.visible
    press(panel._undo)
    assert panel.edits() == [] and shown.content.edit is None and shown.mesh is None


def test_a_box_is_where_its_handle_is_and_as_large_as_its_sliders_say(editing, result):
    panel, _, _ = editing
    panel._where.value = "Box"
    wait_until(lambda: panel._gizmo is not None)
    panel._gizmo.position = result.scale.to_page(FRONT)
    for slider in panel._sizes:
        slider.value = 20.0
    press(panel._apply)
    box = panel.edits()[0].region
    assert isinstance(box, BoxRegion)
    np.testing.assert_allclose(box.centre, FRONT, atol=1e-3)
    np.testing.assert_allclose(box.half, 10.0)


def test_a_click_of_the_brush_paints_in_millimetres_and_edits_stack_until_all_are_removed(editing, result):
    panel, context, shown = editing
    press(panel._apply)
    panel._where.value = "Brush"
    wait_until(lambda: context.pointer._tool is not None)
    panel._material.value, panel._colour.value, panel._radius.value = OWN, (255, 0, 0), 12.0
    click(context, result, FRONT, EYE)
    gold, red = panel.edits()
    assert isinstance(red.region, BrushRegion) and red.region.radius == pytest.approx(12.0) and red.region.on_object
    np.testing.assert_allclose(red.region.centre, FRONT, atol=1.0)
    assert colour_at(shown.mesh, FRONT)[1] < 80, "red with a little mirrored white"
    np.testing.assert_allclose(decode_srgb(colour_at(shown.mesh, FRONT + 30 * UP)), gold.material.mirrored, atol=0.01)
    press(panel._reset)
    assert panel.edits() == [] and shown.mesh is None


def test_choosing_another_place_puts_the_brush_down(editing):
    panel, context, _ = editing
    panel._where.value = "Brush"
    wait_until(lambda: context.pointer._tool is not None)
    panel._where.value = "Ground"
    wait_until(lambda: context.pointer._tool is None)


def test_a_channel_is_shown_with_its_legend_and_light_again_without(editing, result):
    panel, _, shown = editing
    panel._channel.value = "Distance"
    wait_until(lambda: shown.content.map_name == "Distance")
    picture = shown.picture(view_of(result), LAMP)
    assert picture.shape[-1] == 3 and "mm" in panel._legend.content
    panel._channel.value = "Light"
    wait_until(lambda: shown.content.map is None)
    assert panel._legend.content == ""


def test_undo_takes_the_last_edit_and_leaves_those_before(editing):
    panel, _, _ = editing
    press(panel._apply)
    panel._where.value = "Ground"
    press(panel._apply)
    press(panel._undo)
    assert [type(edit.region) for edit in panel.edits()] == [ObjectRegion]


def test_a_view_is_edited_once_however_often_its_light_moves(editing, result):
    panel, _, shown = editing
    press(panel._apply)
    view = view_of(result)
    assert isinstance(shown.content.edit, CachedEdits)
    assert shown.content.edit(view) is shown.content.edit(view)


def test_a_colour_of_ones_own_is_matt_without_shininess_and_never_sends_back_more_than_all():
    matt, polished = own_material((255, 128, 0), 0.0), own_material((255, 128, 0), 1.0)
    assert matt.mirrored == (0.0, 0.0, 0.0) and matt.albedo is not None and max(matt.albedo) <= 1
    assert polished.mirrored[0] > 0 and polished.roughness < 0.2 < own_material((0, 0, 0), 0.2).roughness


def test_edits_stay_when_the_run_is_finished_again(editing, result):
    panel, _, shown = editing
    press(panel._apply)
    shown.mesh = None
    panel.show(result)
    assert shown.mesh is not None and len(panel.edits()) == 1
