"""What strangers' habits and hostile inputs broke, what happens now, and the test of each line."""
