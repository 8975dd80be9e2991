"""The signed distance grid on the CPU.

Comes in: values at nodes, in voxels.
Goes out: blocks near the surface, rays through them (hits, shadows, gradients), and the level set's motion. The
    compiled kernels are here.
"""
