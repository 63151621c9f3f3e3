"""What no catalogued cause explains: a missing force, where, when and in which direction."""
