"""The solver.

Comes in: a Scene, FitConfig, and a first surface.
Goes out: SolvedScene: the surface whose shadows, outline and normals agree with the labels; resumable at any moment.
"""
