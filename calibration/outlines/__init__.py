"""Lights from the outlines of shadows and object: silhouette coherence, with the camera as one more light.

Comes in: the shadows and the object as calibration.ground finds them, and the posed camera.
Goes out: light positions up to common motions that change no shadow, and the residuals of coherence.
"""
