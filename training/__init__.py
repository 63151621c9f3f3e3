"""Studies: ``actions`` of grippers, the paper's ``ablation`` (``python -m torchcloth.training.ablation``)."""

if __name__ != "torchcloth.training":
    raise ImportError(f"got {__name__!r}; import this package as torchcloth.training")
