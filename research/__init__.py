"""Code that the wheel does not hold: other people's methods, for comparison with ours."""
