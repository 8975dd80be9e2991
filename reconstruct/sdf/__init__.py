"""The signed distance grid on the CPU, with its compiled kernels.

Comes in: SDF values at nodes, in voxels.
Goes out: blocks near the surface, results of rays (hits, transmittance, gradients), and steps of the level set.
"""
