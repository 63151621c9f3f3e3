"""The fused engine: the substeps of ``dynamics/substep.py`` in C++, many in one call, with adjoint and tangents.

From the model to the numbers, in the order in which to read:

    choice       which engine runs a cloth, and why
    fused        in the place of ``functional.rollout``: start here
    lowering     the model becomes a program, each part by its file in ``parts/``; read beside ``functional.step``
    program      fields, loops and stages: what one substep does, handed over to the library
    running      a program on tensors: values, adjoint, tangents; ``operators`` makes it differentiable for torch
    devices      the same where the tensors are, on a CUDA device by ``cuda``
    library      the compiled ``csrc/``, built by ``building`` at first use

``torch_parts`` runs a user's own effects and materials beside it, ``tangents`` is below ``Cloth.sensitivities``.
``docs/engine.md`` says what runs where, and what it costs.
"""
