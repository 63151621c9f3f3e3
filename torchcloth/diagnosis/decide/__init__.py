"""The decision: which cause is named, and the verdict."""
