"""Statistics of a diagnosis: linearisation, noise, fits, score tests, comparison on held-out motions."""
