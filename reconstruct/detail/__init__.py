"""Detail finer than the grid.

Comes in: SolvedScene and the photos at full resolution.
Goes out: normals and albedo at the photos' own pixels, with a confidence.
"""
