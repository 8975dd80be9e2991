"""Segmentation of a picture into two regions at least cost (minimum cut)."""

import numpy as np
from jaxtyping import Bool, Float, Integer
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, maximum_flow

RESOLUTION = 1000  # integer units per unit of cost: the flow is exact in integers


def cheapest_region(
    gain: Float[np.ndarray, "height width"],
    across_columns: Float[np.ndarray, "height width_less_1"],
    across_rows: Float[np.ndarray, "height_less_1 width"],
) -> Bool[np.ndarray, "height width"]:
    """Find the region whose pixels gain most, less the costs of the links that its outline cuts.

    Solved exactly as a minimum cut (Greig, Porteous and Seheult 1989), by scipy's maximum flow.

    Args:
        gain: of a pixel in the region over the same outside it, as log odds.
        across_columns, across_rows: cost of a link between neighbours in a row, and in a column.
    """
    height, width = gain.shape
    count = height * width
    source, sink = count, count + 1
    place = np.arange(count).reshape(height, width)
    links = [
        (np.full(count, source), place.ravel(), np.maximum(gain, 0).ravel()),
        (place.ravel(), np.full(count, sink), np.maximum(-gain, 0).ravel()),
    ]
    for first, second, cost in (
        (place[:, :-1], place[:, 1:], across_columns),
        (place[:-1], place[1:], across_rows),
    ):
        links += [(first.ravel(), second.ravel(), cost.ravel()), (second.ravel(), first.ravel(), cost.ravel())]
    start, end, cost = (np.concatenate(x) for x in zip(*links, strict=True))
    capacity = np.rint(cost.astype(float) * RESOLUTION).astype(np.int32)
    some = capacity > 0
    graph = csr_matrix((capacity[some], (start[some], end[some])), shape=(count + 2, count + 2))
    left = graph - maximum_flow(graph, source, sink).flow
    left.data[left.data < 0] = 0
    left.eliminate_zeros()
    inside = np.zeros(count + 2, bool)
    inside[breadth_first_order(left, source, return_predecessors=False)] = True
    return inside[:count].reshape(height, width)


def parts_of(
    region: Bool[np.ndarray, "height width"],
    joined_columns: Bool[np.ndarray, "height width_less_1"],
    joined_rows: Bool[np.ndarray, "height_less_1 width"],
) -> Integer[np.ndarray, "height width"]:
    """Label the connected parts of the region from 1, 0 outside; neighbours connect only where joined."""
    height, width = region.shape
    place = np.arange(height * width).reshape(height, width)
    beside = region[:, 1:] & region[:, :-1] & joined_columns
    below = region[1:] & region[:-1] & joined_rows
    first = np.concatenate([place[:, :-1][beside], place[:-1][below]])
    second = np.concatenate([place[:, 1:][beside], place[1:][below]])
    graph = csr_matrix((np.ones(len(first)), (first, second)), shape=(place.size, place.size))
    labels = np.asarray(connected_components(graph, directed=False)[1]).reshape(height, width)
    out = np.zeros((height, width), int)
    out[region] = np.unique(labels[region], return_inverse=True)[1] + 1
    return out
