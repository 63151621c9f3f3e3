"""Programs of the engine on a CUDA device: the same kernels, written down as CUDA C++ and compiled there.

From the top: ``runs`` (a job on tensors), ``source`` (a program as CUDA C++), ``of_loops``, ``of_stencils`` and
``of_layers`` (its stages), ``arithmetic`` (its kernels), ``listing`` (what it consists of), ``driver`` (compiler and
device).
"""
