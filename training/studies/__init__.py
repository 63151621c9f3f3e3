"""The paper's experiments with its tables beside ours: ``python -m torchcloth.training.studies NAME``."""
