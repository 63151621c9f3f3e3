"""Programs of the engine on a CUDA device: the same kernels, written down as CUDA C++ and compiled there.

From the top: ``runs`` (a job on tensors), ``compiled`` (a program's kernels on a device), ``source`` (a program as CUDA
C++), ``arithmetic`` (its kernels), ``listing`` (what it consists of), ``driver`` (the compiler and the device).
"""
