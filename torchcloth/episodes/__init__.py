"""Recorded episodes as tensors, and the simulated world that replays them."""
