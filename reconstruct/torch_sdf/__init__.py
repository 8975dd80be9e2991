"""The signed distance grid in torch.

Comes in: a grid and rays on any device.
Goes out: the same hits, visibilities and motion as reconstruct/sdf, differentiable, and the equations of ShadowNeuS
    and NeuS as published.
"""
