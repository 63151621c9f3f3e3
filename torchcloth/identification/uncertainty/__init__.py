"""Error bars: covariance, identifiability, profile likelihood, mesh correction, posterior samples."""
