"""The solver.

Comes in: a Scene, FitConfig, and a first surface.
Goes out: SolvedScene: the surface whose shadows, outline and normals agree with the labels, with lights refined;
    resumable at any moment.
"""
