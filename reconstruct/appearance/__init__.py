"""Reflectance.

Comes in: pixels under many lights, with normals.
Goes out: albedo and specular lobes, and what they reflect.
"""
