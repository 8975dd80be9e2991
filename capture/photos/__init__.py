"""Photos as linear light.

Comes in: decoded pixels.
Goes out: Photo and PhotoStack: linear RGB with 1.0 = saturation, one white balance, room light subtracted.
"""
