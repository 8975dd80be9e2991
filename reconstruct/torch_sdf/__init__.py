"""The signed distance grid in torch, differentiable, on any device.

Comes in: a grid, and rays.
Goes out: the same hits, transmittances and steps as of reconstruct/sdf, and the equations of ShadowNeuS and NeuS as
    published.
"""
