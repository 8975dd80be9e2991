"""Scenes that come with camera and lights.

Comes in: a folder in the layout of ShadowNeuS, DeepShadow, S3-NeRF, RTI, DiLiGenT or our own.
Goes out: a KnownScene, with notes on what was assumed.
"""
