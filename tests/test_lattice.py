import pytest
import torch

from reconstruct.render.receivers import between, lattice


@pytest.mark.parametrize("every", [1, 2, 3])
def test_what_is_linear_across_a_picture_is_interpolated_exactly(every):
    row, column = torch.meshgrid(torch.arange(13.0), torch.arange(19.0), indexing="ij")
    plane = torch.stack([row, column, 2 + 0.3 * row - 0.1 * column], -1)
    everywhere = torch.ones(13, 19, dtype=torch.bool)
    known = lattice(everywhere, every)
    assert known.sum() <= (13 // every + 1) * (19 // every + 1)
    found = between(plane * known[..., None], known, everywhere, every)
    whole = (slice(0, 12 // every * every + 1), slice(0, 18 // every * every + 1))  # nothing lies beyond the last node
    torch.testing.assert_close(found[whole], plane[whole])


def test_pixels_without_a_node_near_them_are_nodes_themselves():
    surface = torch.zeros(9, 9, dtype=torch.bool)
    surface[5, 5] = surface[0, 0] = surface[0, 1] = True
    assert torch.equal(torch.nonzero(lattice(surface, 2)), torch.tensor([[0, 0], [5, 5]]))


def test_nothing_of_what_is_no_part_of_the_surface_is_blended_in():
    lit = torch.ones(8, 8, dtype=torch.bool)
    surface = lit.clone()
    surface[2:5, 2:5] = False  # an object, all of whose pixels are known
    known = ~surface | lattice(surface, 2)
    values = torch.where(surface[..., None], 0.25, 7.0).expand(8, 8, 3).contiguous()
    found = between(values * known[..., None], known, surface, 2)
    torch.testing.assert_close(found, values)
