"""What is run by hand: ``fit`` (Lightning), the paper's ``ablation``, ``studies`` with tables beside the paper's."""

if __name__ != "torchcloth.training":
    raise ImportError(f"got {__name__!r}; import this package as torchcloth.training")
