"""Labels of the pixels.

Comes in: a Scene.
Goes out: Labels: ground or object, lit or in shadow under each light, normals by photometric stereo; and the pixels
    that are held out to judge the result.
"""
