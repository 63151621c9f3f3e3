"""The DiffCP paper's ablation on garments: ``python -m torchcloth.training.ablation --out DIR``."""
