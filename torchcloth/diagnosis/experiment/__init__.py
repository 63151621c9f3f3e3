"""Proposals for the next experiment."""
