"""The tabs "Material" and "Inspect" in a real browser."""

from dataclasses import replace

import fake_run
import numpy as np
import pytest
import torch
from chromium import Followed, canvas_picture, canvas_pixels, open_page, pictures, wait_until

from reconstruct.fields import save_fields
from viewer.panels.colouring import EVIDENCE

pytestmark = pytest.mark.browser


@pytest.fixture
def finished(tmp_path, truth):
    run = tmp_path / "heap"
    fake_run.start_run(run, truth)
    fake_run.finish_run(run, truth)
    fields = fake_run.fields_of(truth)
    save_fields(replace(fields, evidence=torch.ones_like(fields.grid.values)), run / "fields.safetensors")
    it = Followed(run)
    yield it
    it.close()


def choose(tab, label: str, option: str) -> None:
    tab.get_by_label(label, exact=True).first.click()
    tab.get_by_role("option", name=option, exact=True).click()


def near_colour(rgb: np.ndarray, colour) -> int:
    """Pixels of nearly this colour, with a little shading."""
    linear_shades = [np.array(colour) * shade for shade in (1.0, 0.93, 0.87)]
    return max(int((np.abs(rgb - shade) < 14).all(-1).sum()) for shade in linear_shades)


@pytest.mark.slow
def test_what_is_known_colours_the_mesh_as_its_legend_says_and_gold_changes_the_picture(browser, finished):
    tab, bad = open_page(browser, finished.url)
    tab.get_by_text("from the surface found").wait_for()
    seen, _ = EVIDENCE[2]
    tab.get_by_role("tab", name="Inspect").click()
    assert near_colour(canvas_pixels(tab), seen) < 300
    choose(tab, "Colour by", "What is known")
    tab.get_by_text("Seen in the photos").wait_for()
    wait_until(tab, lambda: near_colour(canvas_picture(tab), seen) > 2000)

    before = pictures(tab)
    tab.get_by_role("tab", name="Material").click()
    tab.get_by_role("button", name="Apply").click()
    tab.get_by_text("Gold: whole object").wait_for()
    wait_until(tab, lambda: set(pictures(tab)) - set(before))
    assert not bad
    tab.close()
