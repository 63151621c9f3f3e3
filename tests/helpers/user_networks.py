"""Networks as a user might write them."""

import torch


class SmallNetwork(torch.nn.Module):
    """Two layers with dropout: a resumed run must restore the random state."""

    def __init__(self, width: int, drop: float = 0.0):
        super().__init__()
        layers = torch.nn.Linear(2, width), torch.nn.Tanh(), torch.nn.Dropout(drop), torch.nn.Linear(width, 1)
        self.layers = torch.nn.Sequential(*layers)

    def forward(self, places):
        return self.layers(places)


class NanGradientNetwork(SmallNetwork):
    """A network whose gradient is NaN from the second step on, as that of a square root at 0."""

    def __init__(self):
        super().__init__(3)
        self.first_weight = self.layers[0].weight.detach().clone()

    def forward(self, places):
        moved = (self.layers[0].weight - self.first_weight).square().sum()
        return super().forward(places) + (0.0 if moved == 0 else 0.0 * (moved - moved.detach()).sqrt())


class BatchNormNetwork(torch.nn.Sequential):
    """A network with running statistics."""

    def __init__(self):
        super().__init__(torch.nn.Linear(2, 3), torch.nn.BatchNorm1d(3), torch.nn.Linear(3, 1))
