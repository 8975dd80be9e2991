"""What the photos say of the ground without any light's place: albedo, how it is lit, shadows, the object on it.

Comes in: a PhotoStack of one fixed camera.
Goes out: GroundField (log albedo, one smooth field of light per photo), and what deviates from it: shadows, the object.
"""
