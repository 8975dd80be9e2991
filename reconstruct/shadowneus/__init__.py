"""ShadowNeuS as published: fields that are trained.

Comes in: a Scene and TrainConfig.
Goes out: SolvedScene, from a network or grid that was trained with the losses of ShadowNeuS.
"""
