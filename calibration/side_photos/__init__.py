"""Handheld photos of object and board in room light: where each camera stood, and the object's silhouette in it.

Comes in: the session's side photos, the tripod's camera with its board, the ground and the object as it sees them.
Goes out: SideView of each photo: posed camera, silhouette, what of it is sure, or the reason why it is left out.
"""
