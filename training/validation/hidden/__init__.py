"""Blind cases: recordings in which the independent engine hides effects, and the programs that reveal them."""
