"""Episodes of a diagnosis: checks, binned residuals, finer meshes, repeatability."""
