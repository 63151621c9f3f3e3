"""The catalogue of causes, each one number that changes the simulated world."""
