"""A user's network."""

import torch


class Small(torch.nn.Module):
    """Two layers with dropout: what is random must be resumed too."""

    def __init__(self, width: int, drop: float = 0.0):
        super().__init__()
        layers = torch.nn.Linear(2, width), torch.nn.Tanh(), torch.nn.Dropout(drop), torch.nn.Linear(width, 1)
        self.layers = torch.nn.Sequential(*layers)

    def forward(self, places):
        return self.layers(places)
