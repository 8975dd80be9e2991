"""Lights from the outlines of shadows and object: silhouette coherence, with the camera as one more light.

Comes in: the shadows and the object as calibration.ground finds them, and the posed camera.
Goes out: light positions up to one number that outlines cannot tell (a homology), and the residuals of coherence.
"""
