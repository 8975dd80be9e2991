"""Normals from shading.

Comes in: the values of pixels, and the light that would reach them.
Goes out: albedo and normal of each pixel by itself, and of all pixels together where the photos are few.
"""
