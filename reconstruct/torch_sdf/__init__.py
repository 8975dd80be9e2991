"""The signed distance grid in torch, differentiable, on any device.

Comes in: a grid, and rays.
Goes out: hits and transmittances with gradients, by the kernels of reconstruct/sdf or by plain torch, and the equations
    of ShadowNeuS and NeuS as published.
"""
