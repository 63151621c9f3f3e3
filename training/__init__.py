"""Lightning fitting runs and studies. Empty so far: ``tc.identify`` fits in one process."""

if __name__ != "torchcloth.training":
    raise ImportError(f"got {__name__!r}; import this package as torchcloth.training")
