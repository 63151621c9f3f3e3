"""Cases of the studies garments, chamfer and factors: three garments with ten manipulations each."""
