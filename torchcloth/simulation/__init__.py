"""Rollouts over frames: schedules of substeps, initial states, forward sensitivities, checks of arguments."""
