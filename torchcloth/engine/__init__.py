"""The fused engine: the substeps in C++, with adjoint and tangents. See docs/engine.md."""
