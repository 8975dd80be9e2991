"""Lights that are given.

Comes in: a list of lights in any layout, or several opinions on one light.
Goes out: Lights in the world frame, their power from the ground, each with its covariance.
"""
