"""The fused engine: the substeps of ``dynamics/substep.py`` in C++, many in one call, with adjoint and tangents.

From the model to the numbers, in the order in which to read:

    dispatch     which engine runs a cloth, and why
    fused        in the place of ``dynamics.substep.rollout``: start here
    lowering     the model becomes a program, each part by its file in ``lowerings/``; read it with ``substep.step``
    builder      the program under construction, the loops that parts share, and the register of lowerings
    program      fields, loops and stages: what one substep does, handed over to the library
    execution    a program on tensors: values, adjoints, tangents; ``operators`` makes it differentiable for torch
    devices      the same where the tensors are, on a CUDA device by ``cuda``
    library      the compiled ``csrc/``, built by ``building`` at first use

``torch_parts`` runs a user's own effects and materials beside the engine. ``tangents`` serves ``Cloth.sensitivities``,
and ``cuda_graphs`` the reference on a CUDA device. ``enums`` has what Python and C++ share.
``docs/explanation/engine.md`` says what runs where, and what it costs.
"""
