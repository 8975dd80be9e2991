"""An object laid anew on another side: how it was turned, and one surface from all of its object poses.

In: each pose's scenes, in its own world, and its own solve (SolvedObjectPose). Out: the rigid motion of each pose into
the world of the first, or the sentence that says why there is none, and the surface that a solve of all scenes begins
with.
"""
