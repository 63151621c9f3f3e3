"""Programs of the engine on a CUDA device: the same kernels, written as CUDA C++ and compiled there.

From the top: ``launch`` (a job on tensors), ``codegen`` (a program as CUDA C++), ``emit_loops``, ``emit_stencils`` and
``emit_contact`` (its stages), ``layout`` (its memory), ``kernel_codegen`` (its kernels), ``program_ir`` (what it
consists of), ``driver`` (compiler and device). ``self_test`` compares a device with the CPU.
"""
