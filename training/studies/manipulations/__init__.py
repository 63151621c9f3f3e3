"""Three garments, ten manipulations each: the cases that the studies garments, chamfer and factors share."""
