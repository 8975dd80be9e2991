"""What the tab "Inspect" says of a finished run of balls and a box, whose truth is known."""

import fake_run
import numpy as np
import pytest
from panel_context import click, make_context, make_tab, result_of
from waiting import wait_until

from capture.errors import ReconstructionError
from reconstruct.evaluate.deviation import ReferenceMesh
from reconstruct.sdf.measure import Length
from viewer.display.pictures import vertex_colours
from viewer.page.controls import continued
from viewer.page.serve import view
from viewer.panels.colouring import EVIDENCE
from viewer.panels.cut_view import area_text
from viewer.panels.inspect import DISTANCE, InspectPanel
from viewer.panels.ruler import length_text
from viewer.widgets.pointer import Ray, Tool

LARGE = np.array([-25.0, 10.0, 35.0]), 35.0  # the first ball of the heap
EYE = np.array([-25.0, -300.0, 35.0])
UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def truth():
    return fake_run.make_truth(width=64, n_lights=6)


@pytest.fixture
def inspecting(server, truth):
    context, shown = make_context(server)
    panel, result = InspectPanel(context, make_tab(context)), result_of(truth, with_evidence=True)
    panel.show(result)
    yield panel, context, shown, result
    panel.close()


def test_at_first_the_mesh_is_as_it_was(inspecting):
    assert inspecting[2].mesh is None


def test_what_is_known_colours_the_seen_side_and_says_so(inspecting):
    panel, _, shown, result = inspecting
    panel._quantity.value = "What is known"
    wait_until(lambda: shown.mesh is not None)
    assert shown.mesh is not None and not shown.is_lit and "Seen in the photos" in panel._legend.content
    near = np.linalg.norm(result.mesh.vertices - [-25, -25, 35], axis=1).argmin()  # of the ball, towards the camera
    blue = vertex_colours(shown.mesh)[near].astype(int)
    assert blue[2] > blue[0] + 60, "seen is blue"
    assert EVIDENCE[2][1] == "Seen in the photos"


def test_a_run_without_evidence_says_so_instead_of_a_colour(server, truth):
    context, shown = make_context(server)
    panel = InspectPanel(context, make_tab(context))
    panel.show(result_of(truth))
    panel._quantity.value = "Uncertainty"
    wait_until(lambda: "run it again" in panel._legend.content)
    assert shown.mesh is None


def test_two_clicks_measure_a_ball_and_the_label_has_its_uncertainty(inspecting):
    panel, context, _, result = inspecting
    centre, radius = LARGE
    panel._ruler._toggle()
    click(context, result, centre, EYE)
    assert panel.lengths() == [] and "second" in panel._ruler._text.content
    click(context, result, centre, centre + np.array([-300.0, 0, 0]))
    words = panel.lengths()[0]
    assert float(words.split()[0]) == pytest.approx(radius * np.sqrt(2), abs=1.0), "half a voxel"
    assert "\N{PLUS-MINUS SIGN}" in words and words.endswith("mm")
    panel._ruler.clear()
    assert panel.lengths() == []


def test_a_click_into_the_sky_and_a_ray_of_nonsense_measure_nothing(inspecting):
    panel, context, _, result = inspecting
    panel._ruler._toggle()
    click(context, result, EYE + 100.0 * UP, EYE)
    click(context, result, np.full(3, np.nan), EYE)
    click(context, result, EYE, EYE)
    assert "first" in panel._ruler._text.content


def test_a_ray_that_no_browser_sends_reaches_no_tool(inspecting):
    _, context, _, result = inspecting
    clicked = []
    tool = Tool(clicked.append, lambda: None)
    context.pointer.take(tool)
    click(context, result, np.full(3, np.nan), EYE)
    click(context, result, np.full(3, np.inf), EYE)
    click(context, result, EYE, EYE)
    assert clicked == []
    click(context, result, LARGE[0], EYE)
    assert len(clicked) == 1
    context.pointer.release(tool)


def test_a_reference_that_is_not_there_is_refused_before_a_page_is_served(tmp_path):
    (tmp_path / "log.jsonl").touch()
    with pytest.raises(ReconstructionError, match="--reference"):
        view(tmp_path, port=0, reference=tmp_path / "absent.ply")


def test_another_tool_ends_measuring(inspecting):
    panel, context, _, result = inspecting
    panel._ruler._toggle()
    clicked = []
    other = Tool(clicked.append, lambda: None)
    context.pointer.take(other)
    assert panel._ruler._button.label == "Measure a length"
    click(context, result, LARGE[0], EYE)
    assert len(clicked) == 1 and panel.lengths() == []
    context.pointer.release(other)


def test_a_level_cut_hides_what_is_above_and_says_its_area(inspecting):
    panel, _, shown, _ = inspecting
    panel._cut._axis.value = "Level, at a height"
    panel._cut._place.value = 35.0
    wait_until(lambda: shown.mesh is not None and shown.mesh.bounds[1, 2] < 35.5)
    discs = np.pi * 35.0**2 + np.pi * (22.0**2 - 13.0**2) + 40 * 25  # both balls and the box
    found = panel._cut._section[1].area
    assert found == pytest.approx(discs, rel=0.02)
    assert area_text(found, 1.0, "mm").split(",")[0] in panel._cut._text.content
    panel._cut._hide.value = "Before the cut"
    wait_until(lambda: shown.mesh is not None and shown.mesh.bounds[0, 2] > 34.5)
    panel._cut._axis.value = "No cut"
    wait_until(lambda: shown.mesh is None)


def test_a_click_onto_the_face_of_a_cut_measures_there_and_not_on_what_is_hidden(inspecting):
    panel, context, shown, result = inspecting
    panel._cut._axis.value = "Level, at a height"
    panel._cut._place.value = 35.0
    wait_until(lambda: shown.mesh is not None and shown.mesh.bounds[1, 2] < 35.5)
    panel._ruler._toggle()
    centre = LARGE[0]
    for aside in (-10.0, 10.0):
        place = centre + np.array([aside, 0.0, 0.0])
        click(context, result, place, place + 300.0 * UP)
    assert float(panel.lengths()[0].split()[0]) == pytest.approx(20.0, abs=0.1)


def test_an_inflated_reference_is_outside_everywhere_and_by_how_much(server, truth):
    result = result_of(truth)
    reference = ReferenceMesh("inflated", fake_run.mesh_of(result.fields, inflate=3.0), "mm")
    context, shown = make_context(server, reference)
    panel = InspectPanel(context, make_tab(context))
    panel.show(result)
    panel._quantity.value = DISTANCE
    wait_until(lambda: shown.mesh is not None)
    numbers = panel._legend.content
    assert "inside inflated" in numbers and "On average" in numbers
    average = float(numbers.split("On average ")[1].split(" ")[0])
    assert 2.0 < average < 3.1, "three, but for the crevices between the shapes"
    assert shown.mesh is not None
    red, _, blue = vertex_colours(shown.mesh).astype(int).mean(0)
    assert blue > red + 60


def test_without_a_reference_there_is_no_such_colouring(inspecting):
    assert DISTANCE not in inspecting[0]._quantity.options


def test_lengths_have_the_digits_they_are_worth():
    plus_minus = "\N{PLUS-MINUS SIGN}"
    assert length_text(Length(12.345, 0.26), "mm") == f"12.3 {plus_minus} 0.3 mm"
    assert length_text(Length(12.345, None), "mm") == "12.3 mm"
    assert length_text(Length(0.12345, 0.0), "scene") == "0.123 units"
    assert "does not meet" in area_text(0.0, 0.0, "mm")


def test_the_error_of_pointing_grows_with_the_distance_and_on_oblique_surfaces(truth):
    result = result_of(truth)
    centre, radius = LARGE[0], float(LARGE[1])
    sigmas = {}
    for away, slant in ((300.0, 0.0), (600.0, 0.0), (300.0, 0.9)):
        target = centre + radius * np.array([slant, 0.0, np.sqrt(1 - slant**2)])  # a place of the upper half
        eye = target + np.array([0.0, 0.0, away])
        origin, end = result.scale.to_page(eye), result.scale.to_page(target)
        sigmas[away, slant] = Ray(origin, end - origin, None, pixel=0.001).pointing_sigma(result)
    assert sigmas[300.0, 0.0] == pytest.approx(0.15, rel=0.2)  # half of a milliradian at 300 mm
    assert sigmas[600.0, 0.0] == pytest.approx(2 * sigmas[300.0, 0.0], rel=0.2)
    assert 1.3 < sigmas[300.0, 0.9] / sigmas[300.0, 0.0] < 3  # at 64 degrees: 2.3 times along one of two axes
    assert Ray(np.zeros(3), np.ones(3), None).pixel == 0.0


def test_a_curve_measured_now_and_then_is_drawn_straight_between():
    seconds = np.arange(6.0)
    values = np.array([np.nan, 1.0, np.nan, np.nan, 8.0, np.nan])
    assert np.allclose(continued(seconds, values), [1, 1, 2, 4, 8, 8])
    assert np.isnan(continued(seconds, np.full(6, np.nan))).all()
