"""Functions that the gradient tests share."""

from torch.func import functional_call

STEP_SIZES = tuple(10.0 ** (-1 - k / 2) for k in range(9))


CONTACT_PARAMETERS = ("contact_stiffness", "shear_stiffness", "cone")


def active_parameters(cloth):
    """Return the parameters that act: without contact those of directors do not."""
    named = {name: value.detach() for name, value in cloth.named_parameters()}
    if cloth.contact is None:
        named = {name: value for name, value in named.items() if not any(key in name for key in CONTACT_PARAMETERS)}
    return named


def simulate(cloth, values, state, motion, times, **options):
    """Simulate with parameters replaced; values may be leaves, duals or batches."""
    return functional_call(cloth, values, (state, motion, times), options)


def step_scales(values):
    """Return scales of change: 1 for logarithms and angles, or the mean absolute value where that is smaller."""
    return {name: min(1.0, float(value.abs().mean())) or 1.0 for name, value in values.items()}
