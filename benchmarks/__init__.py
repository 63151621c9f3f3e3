"""Speed, memory and start-up time, compared with other simulators: ``torchcloth bench --help``."""

if __name__ != "torchcloth.benchmarks":
    raise ImportError(f"got {__name__!r}; import this package as torchcloth.benchmarks")
