"""The paper as published.

Comes in: a Scene and TrainConfig.
Goes out: Fields, from a trained network or grid, by the losses of ShadowNeuS.
"""
