"""The base model, and extended models on disk."""
