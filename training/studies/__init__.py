"""Studies, among them the paper's experiments with its tables: ``python -m torchcloth.training.studies NAME``."""
