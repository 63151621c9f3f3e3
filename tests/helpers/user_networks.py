"""A user's network."""

import torch


class SmallNetwork(torch.nn.Module):
    """Two layers with dropout: what is random must be resumed too."""

    def __init__(self, width: int, drop: float = 0.0):
        super().__init__()
        layers = torch.nn.Linear(2, width), torch.nn.Tanh(), torch.nn.Dropout(drop), torch.nn.Linear(width, 1)
        self.layers = torch.nn.Sequential(*layers)

    def forward(self, places):
        return self.layers(places)


class NanGradientNetwork(SmallNetwork):
    """Its gradient is no number from the second step on: of a root that has come to nothing, say."""

    def __init__(self):
        super().__init__(3)
        self.begun = self.layers[0].weight.detach().clone()

    def forward(self, places):
        moved = (self.layers[0].weight - self.begun).square().sum()
        return super().forward(places) + (0.0 if moved == 0 else 0.0 * (moved - moved.detach()).sqrt())


class BatchNormNetwork(torch.nn.Sequential):
    """It remembers what it has seen."""

    def __init__(self):
        super().__init__(torch.nn.Linear(2, 3), torch.nn.BatchNorm1d(3), torch.nn.Linear(3, 1))
