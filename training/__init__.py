"""Lightning fitting runs and studies."""

if __name__ != "torchcloth.training":
    raise ImportError(f"got {__name__!r}; import this package as torchcloth.training")
