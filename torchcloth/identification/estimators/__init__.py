"""Searches for the unknowns: Levenberg-Marquardt, gradient descent, statistical linearisation, several starts."""
