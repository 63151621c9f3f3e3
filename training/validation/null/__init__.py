"""How far torchcloth is from the independent engine when nothing is hidden."""
