"""Which kernels materials, effects and boundaries are."""
